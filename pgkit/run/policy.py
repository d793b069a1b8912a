"""A trained policy, loaded from a run directory, on plain NumPy."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pgkit.errors import UserError
from pgkit.run.agent import Agent, Which, restored
from pgkit.run.evaluate import Acting


@dataclass
class Policy:
    """A policy with its observation normalizer, and the env it was trained for.

    ``to_env`` makes of the policy's actions what the environment takes, as in training; None leaves them.
    ``observation_shape`` is a mapping from names to shapes where the policy reads the entries of a Dict;
    ``observation_dtype`` names their types where they are not float32.
    """

    actor: torch.nn.Module
    make_env: Callable[..., Any]
    observation_shape: tuple[int, ...] | dict[str, tuple[int, ...]]
    to_env: Callable[[np.ndarray], np.ndarray] | None = None
    frames: int = 0
    observation_dtype: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._acting = Acting(self.actor)
        self._begins = True

    def reset(self) -> None:
        """An episode begins at the next :meth:`predict`: a recurrent policy forgets. No other needs it."""
        self._acting.state, self._begins = None, True

    def predict(self, obs: Any, deterministic: bool = True) -> np.ndarray:
        """Action for one observation ``[*obs]``, or actions ``[N, *action]`` for a batch ``[N, *obs]``.

        Where the policy reads the entries of a Dict, ``obs`` is a mapping from their names to arrays. The actions are
        what the environment takes: continuous ones are clipped to its bounds. A wrong shape is a UserError.
        """
        shapes = self.observation_shape
        shapes = shapes if isinstance(shapes, dict) else {"observation": shapes}
        given = obs if isinstance(obs, Mapping) else {"observation": obs}
        entries, single = {}, False
        for name, shape in shapes.items():
            if name not in given:
                raise UserError(f"predict got {', '.join(given)}; the policy takes the entries {', '.join(shapes)}")
            x = np.asarray(given[name], dtype=self.observation_dtype.get(name, "float32"))
            single = x.shape == shape
            if not single and x.shape[1:] != shape:
                raise UserError(
                    f"predict got an {name} of shape {list(x.shape)}; the policy takes {list(shape)} or a batch"
                )
            entries[name] = torch.from_numpy(x[None] if single else x)
        begun = torch.full((len(next(iter(entries.values()))),), self._begins)
        action = self._acting(entries, begun, deterministic)["action"].cpu().numpy()
        self._begins = False
        action = action if self.to_env is None else self.to_env(action)
        return action[0] if single else action


def describe_env(env: Any) -> dict[str, Any]:
    """What :class:`Policy` must know of an env: the observation's shape and type, and how actions become its own."""
    spec = env.observation_spec_unbatched
    shapes = {name: tuple(spec[name].shape) for name in spec.keys(True, True)}
    dtypes = {name: str(spec[name].dtype).removeprefix("torch.") for name in shapes}
    return {
        "observation_shape": shapes["observation"] if list(shapes) == ["observation"] else shapes,
        "to_env": env.to_env,
        "observation_dtype": {name: dtype for name, dtype in dtypes.items() if dtype != "float32"},
    }


def load_policy(
    run_dir: str | Path,
    which: Which = "best",
    *,
    agent: Callable[..., Agent] | None = None,
    trust: bool = False,
) -> Policy:
    """The policy of a run: ``best`` by ``eval/mean_reward``, or ``latest``; arguments as in :func:`load_agent`."""
    built, args, env, frames = restored(Path(run_dir), which, agent, trust, only_actor=True)
    return Policy(built.actor.eval(), args.make_env, **describe_env(env), frames=frames)
