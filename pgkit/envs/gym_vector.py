"""A vector of Gymnasium's own kind: ``gymnasium.make_vec``, ALE's ``AtariVectorEnv`` and others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor
from torchrl.data import Composite

from pgkit.envs import spaces
from pgkit.envs.checks import WRONG, misshapen
from pgkit.envs.failures import FAILURES, fail, in_vector
from pgkit.envs.numpy_entries import Info, Infos, Observations, Totals, flags, rewards
from pgkit.envs.seeding import episode_seed
from pgkit.errors import UserError
from pgkit.seams import Entries, Step


class GymnasiumVector:
    """A :class:`~pgkit.seams.Simulator` of a ``gymnasium.vector.VectorEnv``.

    How it begins a new episode is read from its ``metadata["autoreset_mode"]``. With ``NEXT_STEP``, Gymnasium's
    default, the step after an episode's end ignores the action and resets: that row is masked, and is no frame. With
    ``SAME_STEP`` the true final observation is taken from ``final_obs``; with ``DISABLED`` the reset is made here.

    Args:
        env: the vector.
        seed: the run's seed; environment ``i`` is seeded with ``seed + i``, once.
        first: index of the first environment, where this is a share of a larger vector.
        flatten, info, options: as for :class:`~pgkit.envs.Gymnasium`.
    """

    device = torch.device("cpu")
    resume: Literal["exact", "new episodes"] = "new episodes"

    def __init__(
        self,
        env: VectorEnv,
        seed: int = 0,
        first: int = 0,
        flatten: bool = True,
        info: Info = (),
        options: Mapping[str, Any] | None = None,
    ) -> None:
        self.env, self.num_envs, self.seed, self.first = env, env.num_envs, seed, first
        self.options = None if options is None else dict(options)
        self.mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self.masks = self.mode is AutoresetMode.NEXT_STEP
        entries = spaces.observation_entries(env.single_observation_space, flatten)
        self.to_env = spaces.to_env(env.single_action_space)
        n = self.num_envs
        self.observation_spec = Composite({entry.key: entry.spec(n) for entry in entries}, shape=(n,))
        self.action_spec = Composite(action=spaces.action_spec(env.single_action_space, n), shape=(n,))
        self.reward_spec, self.done_spec = rewards(n), flags(n)
        self._fresh, self._next, self._infos = Observations(entries, n), Observations(entries, n), Infos(info, n)
        self.info_spec, self._totals = self._infos.spec, Totals(n)
        self.episode_reward, self.step_count = self._totals.returns, self._totals.steps
        self._ended = np.ones(n, bool)  # whose episode the last step ended
        self._steps, self._begun = 0, False

    def reset(self, seed: int | None = None, rows: Tensor | None = None) -> Entries:
        """As :meth:`pgkit.seams.Simulator.reset`; ``rows`` asks for Gymnasium's ``options={"reset_mask": ...}``."""
        if rows is not None:
            begun = np.zeros(self.num_envs, bool) if self.masks else self._ended  # those were reset in their last step
            return self._reset_rows(rows.numpy() & ~begun)
        if seed is not None or not self._begun:
            first_time = seed is not None or not self._steps
            self.seed, self._steps = (self.seed, self._steps) if seed is None else (seed, 0)
            seed = self.seed % (2**31 - self.num_envs)  # Gymnasium adds the environment's number; 31 bits
            try:
                obs, _ = self.env.reset(seed=seed if first_time else None, options=self.options)
            except FAILURES as error:
                fail(in_vector(self.env, self.first, self.num_envs, 0, seed), error)
            self._write(self._fresh, obs, "reset")
            self._totals.forget(np.ones(self.num_envs, bool))
            self._ended[:], self._begun = False, True
        return self._fresh.tensors

    def _reset_rows(self, rows: np.ndarray) -> Entries:
        if rows.any():
            obs, _ = self.env.reset(options={**(self.options or {}), "reset_mask": rows.copy()})
            self._write(self._fresh, obs, "reset")
            self._totals.forget(rows)
            self._ended &= ~rows
        return self._fresh.tensors

    def step(self, action: Entries) -> Step:
        """As :meth:`pgkit.seams.Simulator.step`."""
        totals, counts = self._totals, ~self._ended if self.masks else None
        totals.forget(self._ended)
        actions = self.to_env(action["action"].numpy())
        try:
            obs, reward, terminated, truncated, info = self.env.step(actions)
        except FAILURES as error:
            fail(in_vector(self.env, self.first, self.num_envs, self._steps + 1, self.seed), error)
        self._write_totals(reward, terminated, truncated)
        totals.count()
        if counts is not None:
            totals.forget(~counts)
        self._infos.clear()
        self._infos.write_all(info)
        self._write(self._next, obs, "step")
        self._fresh.copy_from(self._next)
        self._ended[:], self._begun = totals.terminated | totals.truncated, False
        self._steps += 1
        if self._ended.any() and self.mode is AutoresetMode.SAME_STEP:
            self._write_finals(info)
        elif self._ended.any() and self.mode is AutoresetMode.DISABLED:
            returns, lengths = totals.episode_reward.copy(), totals.step_count.copy()
            ended = self._ended.copy()
            self._reset_rows(ended)
            totals.episode_reward[:], totals.step_count[:], self._ended[:] = returns, lengths, ended
        return Step(
            self._next.tensors, totals.rewards, totals.ends, totals.cuts, self._infos.tensors, self._fresh.tensors,
            None if counts is None else torch.from_numpy(counts),
        )  # fmt: skip

    def _write(self, into: Observations, obs: Any, method: str) -> None:
        try:
            into.write_all(obs, self.env.observation_space)
        except WRONG as error:
            raise misshapen(self.env, method, error) from error

    def _write_totals(self, reward: Any, terminated: Any, truncated: Any) -> None:
        totals, flags = self._totals, {"terminations": terminated, "truncations": truncated}
        for name, x in {"rewards": reward, **flags}.items():
            found, kinds = np.asarray(x), "b" if name in flags else "fiub"
            if found.shape != totals.reward.shape or found.dtype.kind not in kinds:
                raise UserError(
                    f"{type(self.env.unwrapped).__name__}.step returned {name} of shape {found.shape} and type "
                    f"{found.dtype}: return {'a bool' if name in flags else 'a number'} for each of the "
                    f"{self.num_envs} environments"
                )
        totals.reward[:], totals.terminated[:], totals.truncated[:] = reward, terminated, truncated

    def _write_finals(self, info: dict[str, Any]) -> None:
        """The true final observations and infos of episodes that were reset in the same step."""
        finals = info.get("final_obs", info.get("final_observation"))
        if finals is None:
            raise UserError(
                f"{type(self.env).__name__} resets in the same step and gives no info['final_obs']: without the final "
                "observation a time limit cannot be told from an end; use autoreset NEXT_STEP"
            )
        for row in np.flatnonzero(self._ended):
            one = {name: x[row] for name, x in finals.items()} if isinstance(finals, dict) else finals[row]
            try:
                self._next.write(int(row), one)
            except WRONG as error:
                raise misshapen(self.env, "step", error) from error
        self._infos.write_all(info.get("final_info", {}), only=self._ended)

    def state_dict(self) -> dict[str, Any]:
        """How many steps were made: what is resumed begins new episodes, others than the first ones."""
        return {"steps": self._steps}

    def load_state_dict(self, state: dict[str, Any]) -> Entries:
        """Begins new episodes."""
        seed = self.seed
        fresh = self.reset(seed=episode_seed(seed, self.first, state["steps"]) if state["steps"] else seed)
        self.seed, self._steps = seed, state["steps"]
        return fresh

    def close(self) -> None:
        """Closes the vector."""
        self.env.close()
