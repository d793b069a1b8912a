"""A trained policy on plain NumPy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torchrl.data import Bounded

from pgkit.envs import vector_of
from pgkit.envs.spaces import ToEnv
from pgkit.errors import UserError
from pgkit.run.args import RunArgs
from pgkit.run.evaluate import Acting
from pgkit.seams import Key, Memory


@dataclass
class Policy:
    """A policy with its observation normalizer, and the env it was trained for.

    ``to_env`` makes of the policy's actions what the environment takes, as in training; None leaves them. Of several
    groups of agents ``by_group`` does so, by the keys of their actions.
    ``observation_shape`` is a mapping from names to shapes where the policy reads the entries of a Dict;
    ``observation_dtype`` names their types where they are not float32.
    """

    actor: torch.nn.Module
    make_env: Callable[..., Any]
    observation_shape: tuple[int, ...] | dict[Any, tuple[int, ...]]
    to_env: Callable[[np.ndarray], np.ndarray] | None = None
    frames: int = 0
    observation_dtype: dict[Any, str] = field(default_factory=dict)
    args: RunArgs | None = None
    by_group: dict[Any, Callable[[np.ndarray], np.ndarray]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._acting = Acting(self.actor, tuple(self.by_group) or (self.action_key,))
        self._begins, self._recurrent = True, self.memory is not None

    @classmethod
    def of(cls, actor: torch.nn.Module, env: Any) -> Policy:
        """The policy of an actor in your own script; ``env`` is what ``envs.make`` gave, and has no other use."""
        return cls(actor, lambda **_: env, **describe_env(env))

    @property
    def shapes(self) -> dict[Key, tuple[int, ...]]:
        """Of the observation's entries that the actor reads, by key."""
        given = self.observation_shape
        given = given if isinstance(given, dict) else {"observation": given}
        actor: Any = self.actor
        return {key: shape for key, shape in given.items() if key in actor.in_keys}

    @property
    def action_key(self) -> Key:
        """The entry that the actor writes its action to; a group's lies under the group's name."""
        actor: Any = self.actor
        written: Any = getattr(actor, "out_keys", ())  # a plain module may write its action as it likes
        return next((key for key in written if key == "action" or key[-1] == "action"), "action")

    @property
    def memory(self) -> Memory | None:
        """The part whose state goes from step to step."""
        return next((part for part in self.actor.modules() if isinstance(part, Memory)), None)

    def dtype(self, key: Key) -> str:
        """The type of an observation's entry, such as ``float32``."""
        return self.observation_dtype.get(key, "float32")

    def reset(self) -> None:
        """An episode begins at the next :meth:`predict`: a recurrent policy forgets. No other needs it."""
        self._acting.state, self._begins = None, True

    def predict(self, obs: Any, deterministic: bool = True, episode_start: Any = None) -> Any:
        """Action for one observation ``[*obs]``, or actions ``[N, *action]`` for a batch ``[N, *obs]``.

        Where the policy reads the entries of a Dict, ``obs`` is a mapping from their names to arrays. A group of agents
        has a dimension more: ``[agents, *obs]`` or ``[N, agents, *obs]``, and actions ``[agents, *action]``. Of several
        groups ``obs`` is a mapping from their names, and so is the result; what has further entries beside the
        observation, an action mask, is a mapping in it. The actions are what the environment takes: continuous ones
        are clipped to its bounds.

        Args:
            obs: numbers; a wrong shape is a UserError.
            deterministic: the likeliest actions, or draws.
            episode_start: flags ``[N]``, which rows begin an episode: there a recurrent policy forgets. None: all at
                the first call and after :meth:`reset`, else none.

        Raises:
            UserError: wrong shapes; or a recurrent policy is given other rows in the middle of their episodes.
        """
        entries, single = self._entries(obs)
        begun = self._begun(len(next(iter(entries.values()))), episode_start)
        actions = {key: x.cpu().numpy() for key, x in self._acting(entries, begun, deterministic).items()}
        self._begins = False
        convert: Any = self.by_group or {self.action_key: self.to_env or (lambda x: x)}
        actions = {key: convert[key](x) for key, x in actions.items()}
        actions = {key: x[0] if single else x for key, x in actions.items()}
        return {key[0]: x for key, x in actions.items()} if self.by_group else actions[self.action_key]

    def _entries(self, obs: Any) -> tuple[dict[Key, torch.Tensor], bool]:
        """What the actor reads as a batch, and whether it was a single observation."""
        given, shapes = self._by_key(obs), self.shapes
        entries, single = {}, False
        for name, shape in shapes.items():
            if name not in given:
                had, reads = (", ".join(map(dotted, keys)) for keys in (given, shapes))
                raise UserError(f"predict got {had}; the policy takes the entries {reads}")
            x = np.asarray(given[name], dtype=self.dtype(name))
            single = x.shape == shape
            if not single and x.shape[1:] != shape:
                raise UserError(
                    f"predict got an {dotted(name)} of shape {list(x.shape)}; the policy takes {list(shape)} or a batch"
                )
            entries[name] = torch.from_numpy(x[None] if single else x)
        return entries, single

    def _begun(self, rows: int, episode_start: Any) -> torch.Tensor:
        if episode_start is None:
            begun = torch.full((rows,), self._begins)
        else:
            begun = torch.as_tensor(np.array(episode_start, bool).reshape(-1))
            if len(begun) != rows:
                raise UserError(
                    f"predict got {len(begun)} flags of episode_start for {rows} observations: one for each"
                )
        state = self._acting.state if self._recurrent else None
        if state is not None and len(state) != rows and not begun.all():
            raise UserError(
                f"predict got {rows} observations after {len(state)}, and this policy remembers each row's episode: "
                "call reset(), or give episode_start=, one flag a row, all True where the rows are others"
            )
        return begun

    def _by_key(self, obs: Any) -> dict[Key, Any]:
        """The arrays given, by the keys that the policy reads them from."""
        group = None if isinstance(self.action_key, str) else self.action_key[:-1]
        if not isinstance(obs, Mapping):
            return {"observation" if group is None else (*group, "observation"): obs}
        flat: dict[Key, Any] = {}
        for name, x in obs.items():
            path = name if isinstance(name, tuple) else (name,)
            if isinstance(x, Mapping):
                flat |= {(*path, inner): value for inner, value in x.items()}
            elif group is not None and len(path) == 1:
                named = any((*path, "observation") == key for key in self.shapes)  # a group's name, or an entry's
                flat[(*path, "observation") if named else (*group, *path)] = x
            else:
                flat[name] = x
        return flat


def dotted(key: Key) -> str:
    """A nested key as one name: ``agents.observation``."""
    return key if isinstance(key, str) else ".".join(key)


def _converter(spec: Any) -> ToEnv:
    """What makes the environment's of a group's actions."""
    if not isinstance(spec, Bounded):
        return ToEnv()
    return ToEnv(spec.low.cpu().numpy(), spec.high.cpu().numpy(), np.dtype(np.float32))


def describe_env(env: Any) -> dict[str, Any]:
    """What :class:`Policy` must know of an env: the observation's shape and type, and how actions become its own."""
    spec, acted = env.observation_spec_unbatched, vector_of(env).action_keys
    shapes = {name: tuple(spec[name].shape) for name in spec.keys(True, True)}
    dtypes = {name: str(spec[name].dtype).removeprefix("torch.") for name in shapes}
    return {
        "observation_shape": shapes["observation"] if list(shapes) == ["observation"] else shapes,
        "to_env": env.to_env,
        "by_group": {key: _converter(env.full_action_spec_unbatched[key]) for key in acted if len(acted) > 1},
        "observation_dtype": {name: dtype for name, dtype in dtypes.items() if dtype != "float32"},
    }
