"""A batched TorchRL environment, transforms included, on its own device."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite
from torchrl.envs import EnvBase

from pgkit.compiled import Mode
from pgkit.envs.failures import FAILURES, fail, in_vector
from pgkit.envs.numpy_entries import as_path
from pgkit.envs.seeding import episode_seed
from pgkit.envs.spaces import ToEnv
from pgkit.envs.torch_halves import innermost, native
from pgkit.errors import UserError
from pgkit.seams import Entries, Key, Step

_COUNTED = {"episode_reward", "step_count", "is_init", "recurrent_state"}  # what pgkit writes by itself


class Torch:
    """A :class:`~pgkit.seams.Simulator` of any TorchRL ``EnvBase`` with one batch dimension, or none.

    An episode that ends is reset within the step through the environment's own partial reset. Nothing leaves the
    device. Continuous actions are clipped to their bounds first.

    A resume begins new episodes, unless the environment's class (under its transforms) says ``resume = "exact"``: it
    then promises that its ``state_dict()`` (its buffers) holds everything that the next step depends on besides the
    entries, the state of its random numbers included.

    Args:
        env: the environment.
        seed: given to ``env.set_seed``.
        first: index of the first environment, where this is a share of a larger vector.
        info: entries of its observation that a policy does not read; they reach the rollout's ``next`` only.
        compile: mode of :func:`pgkit.compiled.compiled` for its step and its reset, recorded on a copy of it. A reset
            has to mind ``_reset`` by masks (``torch.where``); what cannot be recorded runs as it is, and the log says
            so.
    """

    masks = False

    def __init__(
        self, env: EnvBase, seed: int = 0, first: int = 0, info: Iterable[Key] = (), compile: Mode = "off"
    ) -> None:
        if len(env.batch_size) > 1:
            raise UserError(
                f"{type(env).__name__} has the batch size {tuple(env.batch_size)}: flatten it to one dimension"
            )
        self.env, self.seed, self.first = env, seed, first
        self._one = not env.batch_size
        self.num_envs = n = env.batch_size.numel()
        self.device = torch.device(env.device or "cpu")
        self.resume: Literal["exact", "new episodes"] = getattr(type(innermost(env)), "resume", "new episodes")
        observed, infos = self._many(env.full_observation_spec), Composite(shape=(n,))
        keys = {_key(key): isinstance(observed[key].zero(), Tensor) for key in observed.keys(True, True)}
        if missing := [key for key in info if not keys.get(key)]:
            raise UserError(f"info={missing[0]!r}: {type(env).__name__} observes {', '.join(map(str, keys))}")
        for key in info:
            infos[key] = observed[key]
        for key, is_tensor in keys.items():
            if key in infos.keys(True) or not is_tensor or as_path(key)[-1] in _COUNTED:
                del observed[key]
        self.observation_spec, self.info_spec = observed, infos
        self.action_spec, self.reward_spec = self._many(env.full_action_spec), self._many(env.full_reward_spec)
        self._ends = [as_path(key)[:-1] for key in env.done_keys if as_path(key)[-1] == "done"]
        self.done_spec = self._many(env.full_done_spec)
        for path in self._ends:
            flag = Categorical(2, self.done_spec[(*path, "done")].shape, dtype=torch.bool, device=env.device)
            self.done_spec[(*path, "terminated")], self.done_spec[(*path, "truncated")] = flag, flag.clone()
        actions = {_key(key): self.action_spec[key] for key in self.action_spec.keys(True, True)}
        self._bounds = {key: (x.low, x.high) for key, x in actions.items() if isinstance(x, Bounded)}
        self._bounds = {k: v for k, v in self._bounds.items() if v[0].is_floating_point()}
        bounds = [[x[0].cpu().numpy() for x in pair] for pair in self._bounds.values()]
        self.to_env = ToEnv(*bounds[0], bounds[0][0].dtype) if bounds else ToEnv()
        self._native = None if compile == "off" else native(env, compile)
        self._restart(seed)

    @property
    def recorded_parts(self) -> list[str]:
        """What runs as native code: ``advance``, the step, and ``renew``, the resets."""
        return [] if self._native is None else self._native[1].names

    def _many(self, spec: Composite) -> Composite:
        return spec.clone().unsqueeze(0) if self._one else spec.clone()

    def _restart(self, seed: int) -> None:
        self.seed, self._steps = seed, 0
        self.env.set_seed(seed % (2**31 - self.num_envs))  # TorchRL adds to it; 31 bits
        self._data: TensorDictBase | None = None  # what the next step is made with
        self._untouched = False
        self._begin_counts()

    def _begin_counts(self) -> None:
        self.episode_reward: Entries = {
            _key(key): self.reward_spec[key].zero() for key in self.reward_spec.keys(True, True)
        }
        self.step_count = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self._begun = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)

    @torch.inference_mode(False)
    @torch.no_grad()
    def reset(self, seed: int | None = None, rows: Tensor | None = None) -> Entries:
        """As :meth:`pgkit.seams.Simulator.reset`."""
        if seed is not None:
            self._restart(seed)
        if self._data is None or (rows is None and not self._untouched):
            self._data = self.env.reset()
            self._untouched = True
            self._begin_counts()
        elif rows is not None:
            return self._reset_rows(rows & ~self._begun)
        return self._entries(self._data, self.observation_spec)

    def _reset_rows(self, rows: Tensor) -> Entries:
        assert self._data is not None
        if rows.any():
            again = self._data.copy()
            for key in self.env.reset_keys:
                done = again.get((*as_path(key)[:-1], "done"))
                again.set(key, rows.reshape(-1, *[1] * (done.ndim - 1)).expand(self.num_envs, *done.shape[1:]))
            self._data = self.env.reset(again)
            self._begun = self._begun | rows
        return self._entries(self._data, self.observation_spec)

    @torch.inference_mode(False)
    @torch.no_grad()
    def step(self, action: Entries) -> Step:
        """As :meth:`pgkit.seams.Simulator.step`."""
        assert self._data is not None
        data = self._data
        for key, x in action.items():
            x = x.clamp(*self._bounds[key]) if key in self._bounds else x.clone()
            data.set(key, x.squeeze(0) if self._one else x)
        try:
            after, self._data = self._advance(data)
        except FAILURES as error:
            fail(in_vector(innermost(self.env), self.first, self.num_envs, self._steps + 1, self.seed), error)
        self._untouched = False
        self._steps += 1
        reward = self._entries(after, self.reward_spec)
        terminated, truncated = self._flags(after)
        step = Step(
            self._entries(after, self.observation_spec), reward, terminated, truncated,
            self._entries(after, self.info_spec), self._entries(self._data, self.observation_spec),
        )  # fmt: skip
        goes_on = ~self._begun
        self.step_count = self.step_count * goes_on + 1
        self.episode_reward = {
            key: before * goes_on.view(-1, *[1] * (before.ndim - 1)) + reward[key]
            for key, before in self.episode_reward.items()
        }
        self._begun = step.begun()
        return step

    def _advance(self, data: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """What ``step_and_maybe_reset`` gives: the entries below ``next``, and what the next step is made with."""
        if self._native is None:
            done, data = self.env.step_and_maybe_reset(data)
            return done.get("next"), data
        halves, run = self._native
        made = run(halves.advance, *[data.get(key) for key in halves.taken])
        after, fresh = halves.filled(halves.next, made[: len(halves.next)]), made[len(halves.next) :]
        if any(bool(after.get(key).any()) for key in self.env.done_keys):
            fresh = run(halves.renew, *fresh)
        return after, halves.filled(halves.fresh, fresh)

    def _entries(self, data: TensorDictBase, spec: Composite) -> Entries:
        found = {_key(key): data.get(key) for key in spec.keys(True, True)}
        found = {key: x.unsqueeze(0) for key, x in found.items()} if self._one else found
        for key, x in found.items():
            if x.shape != spec[key].shape:
                raise self._wrong(key, x, tuple(spec[key].shape))
        return found

    def _wrong(self, key: Key, x: Tensor, expected: Any) -> UserError:
        found, name = f"of shape {tuple(x.shape)} and type {x.dtype}", ".".join(as_path(key))
        return UserError(f"{type(innermost(self.env)).__name__} gave '{name}' {found}, its spec says {expected}")

    def _flags(self, after: TensorDictBase) -> tuple[Entries, Entries]:
        terminated, truncated = {}, {}
        for path in self._ends:
            done, ended = after.get((*path, "done")), after.get((*path, "terminated"), None)
            ended, cut = done if ended is None else ended, after.get((*path, "truncated"), None)
            for name, x in (("done", done), ("terminated", ended), ("truncated", done if cut is None else cut)):
                if x.dtype != torch.bool or x.shape != done.shape:
                    raise self._wrong((*path, name), x, f"bool {tuple(done.shape)}")
            cut = done & ~ended if cut is None else cut
            both = (ended.unsqueeze(0), cut.unsqueeze(0)) if self._one else (ended, cut)
            terminated[_key((*path, "terminated"))], truncated[_key((*path, "truncated"))] = both
        return terminated, truncated

    def state_dict(self) -> dict[str, Any]:
        """The environment's own state, and with ``resume = "exact"`` what its next step is made with."""
        own = [copy.deepcopy(env.state_dict()) for env in dict.fromkeys((self.env, innermost(self.env)))]
        state: dict[str, Any] = {"steps": self._steps, "env": own}
        if self.resume == "exact":
            state |= {
                "data": None if self._data is None else self._data.clone().to_dict(),
                "counts": (self.episode_reward, self.step_count, self._begun),
            }
        return state

    def load_state_dict(self, state: dict[str, Any]) -> Entries:
        """Goes on exactly, or begins new episodes with a seed of their own."""
        exact = self.resume == "exact" and "env" in state
        seed, begins = self.seed, not exact and state["steps"]
        self._restart(episode_seed(seed, self.first, state["steps"]) if begins else seed)
        self.seed, self._steps = seed, state["steps"]
        for env, own in zip(
            dict.fromkeys((self.env, innermost(self.env))), state.get("env", ()), strict="env" in state
        ):
            env.load_state_dict(own)
        if exact and state["data"] is not None:
            self._data = TensorDict(state["data"], batch_size=self.env.batch_size, device=self.env.device)
            returns, *counts = state["counts"]
            self.episode_reward = {key: x.to(self.device) for key, x in returns.items()}
            self.step_count, self._begun = (x.to(self.device) for x in counts)
            return self._entries(self._data, self.observation_spec)
        return self.reset()

    def close(self) -> None:
        """Closes the environment."""
        if not self.env.is_closed:
            self.env.close()


def _key(key: Any) -> Key:
    path = as_path(key)
    return path[0] if len(path) == 1 else path
