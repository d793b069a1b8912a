"""Gymnasium environments stepped one by one: same-step autoreset, true final observations, exact replay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NoReturn

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor
from torchrl.data import Composite

from pgkit.envs import spaces
from pgkit.envs.checks import FLAGS, NUMBERS, WRONG, check_step, checked_reset, checked_space, misshapen
from pgkit.envs.failures import FAILURES, LONGEST, fail, in_episode, warn_of_length
from pgkit.envs.numpy_entries import Info, Infos, Observations, Totals, flags, rewards
from pgkit.envs.seeding import episode_seed
from pgkit.errors import UserError
from pgkit.seams import Entries, Step


class Gymnasium:
    """A :class:`~pgkit.seams.Simulator` of ``gym.Env`` objects in this process, on NumPy.

    An episode that ends is reset within the same step. Every episode is seeded from ``(seed, index of the environment,
    number of the episode)``, so the state of a deterministic simulator is those numbers and the actions since: that
    is what :meth:`state_dict` stores and :meth:`load_state_dict` replays, bit for bit. Of an episode beyond 100,000
    steps the actions are dropped: there, a resume begins the next episode. With ``reseed=False`` an environment is
    seeded once, and a resume begins new episodes.

    Args:
        envs: the environments.
        seed: the run's seed.
        first: index of the first one, where this is a share of a larger vector.
        flatten: False keeps the entries of a Dict observation apart.
        info: entries of ``info`` that a step gives.
        clip_rewards: a step's reward is clipped to [-1, 1]; the episode's counts as it is.
        reseed: seed every episode; False: the first one of each environment only.
        options: given to every reset.
    """

    device = torch.device("cpu")
    masks = False

    def __init__(
        self,
        envs: Sequence[gym.Env],
        seed: int = 0,
        first: int = 0,
        flatten: bool = True,
        info: Info = (),
        clip_rewards: bool = False,
        reseed: bool = True,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        if len({id(env.unwrapped) for env in envs}) < len(envs):
            raise UserError("the function that makes an environment gave the same one twice: it must make a new one")
        self.envs, self.num_envs, self.first, self.clip_rewards = envs, len(envs), first, clip_rewards
        self.reseed, self.options = reseed, None if options is None else dict(options)
        self.resume: Literal["exact", "new episodes"] = "exact" if reseed else "new episodes"
        observed, acted = (checked_space(envs[0], name) for name in ("observation_space", "action_space"))
        entries = spaces.observation_entries(observed, flatten)
        self.to_env = spaces.to_env(acted)
        n = self.num_envs
        self.observation_spec = Composite({entry.key: entry.spec(n) for entry in entries}, shape=(n,))
        self.action_spec = Composite(action=spaces.action_spec(acted, n), shape=(n,))
        self.reward_spec, self.done_spec = rewards(n), flags(n)
        self._fresh, self._next, self._infos = Observations(entries, n), Observations(entries, n), Infos(info, n)
        self.info_spec, self._totals = self._infos.spec, Totals(n)
        self.episode_reward, self.step_count = self._totals.returns, self._totals.steps
        self._result = Step(
            self._next.tensors, self._totals.rewards, self._totals.ends, self._totals.cuts, self._infos.tensors,
            self._fresh.tensors,
        )  # fmt: skip
        self._stepped = self._warned = False
        self._restart(seed)

    def _restart(self, seed: int) -> None:
        self.seed = seed
        self._totals.forget(np.ones(self.num_envs, bool))
        self._begun = np.zeros(self.num_envs, bool)  # the episode was begun and has not been stepped since
        self._seeds: list[int | None] = [None] * self.num_envs  # of the running episodes
        self._seeded = np.zeros(self.num_envs, bool)
        self._episode = np.full(self.num_envs, -1)
        self._taken: list[np.ndarray] = []  # actions [N, ...] of the last steps
        self._since = np.zeros(self.num_envs, np.int64)  # where in those each episode begins
        self._endless = np.zeros(self.num_envs, bool)  # whose episode is too long to be replayed

    def reset(self, seed: int | None = None, rows: Tensor | None = None) -> Entries:
        """As :meth:`pgkit.seams.Simulator.reset`."""
        if seed is not None:
            self._restart(seed)
        for i in range(self.num_envs) if rows is None else np.flatnonzero(rows.numpy()):
            if not self._begun[i]:
                self._begin(i)
        return self._fresh.tensors

    def _begin(self, i: int) -> None:
        self._episode[i] += 1
        seeds = self.reseed or not self._seeded[i]
        seed = episode_seed(self.seed, self.first + i, int(self._episode[i])) if seeds else None
        self._seeds[i] = seed
        try:
            obs = checked_reset(self.envs[i], seed, self.options)
        except FAILURES as error:
            fail(in_episode(self.envs[i].unwrapped, self.first + i, 0, seed), error)
        self._write(i, obs, "reset")
        self._begun[i], self._seeded[i], self._endless[i] = True, True, False
        self._since[i] = len(self._taken)
        if 2 * int(self._since.min()) > len(self._taken):  # more than half belongs to episodes that are over
            self._forget()

    def _forget(self) -> None:
        """Drops the actions that belong to no running episode."""
        oldest = int(self._since.min())
        del self._taken[:oldest]
        self._since -= oldest

    def _give_up(self) -> None:
        """Drops the actions of episodes that have become too long."""
        for i in np.flatnonzero(len(self._taken) - self._since > LONGEST):
            if not self._warned:
                self._warned = True
                warn_of_length(self.envs[i].unwrapped, self.first + int(i))
            self._endless[i], self._since[i] = True, len(self._taken)
        self._forget()

    def _fail(self, i: int, error: BaseException) -> NoReturn:
        step = int(self._totals.step_count[i]) + 1
        fail(in_episode(self.envs[i].unwrapped, self.first + i, step, self._seeds[i]), error)

    def _write(self, i: int, obs: Any, method: str) -> None:
        try:
            self._fresh.write(i, obs)
        except WRONG as error:
            raise misshapen(self.envs[i], method, error) from error

    def step(self, action: Entries) -> Step:
        """As :meth:`pgkit.seams.Simulator.step`; Box actions are clipped to their bounds first."""
        if self._begun.any():
            self._totals.forget(self._begun)
            self._begun[:] = False
        totals, actions = self._totals, self.to_env(action["action"].numpy())
        given = actions.copy()  # an environment may change its action in place, the history stays
        reward, terminated, truncated, looks = totals.reward, totals.terminated, totals.truncated, not self._stepped
        infos, write = self._infos if self._infos.tensors else None, self._next.write
        if infos is not None:
            infos.clear()
        for i, env in enumerate(self.envs):
            try:
                result = env.step(given[i])
            except FAILURES as error:
                self._fail(i, error)
            if looks or type(result) is not tuple or len(result) != 5:
                check_step(env, actions[i], result)
            obs, gained, ended, cut, info = result
            if type(gained) not in NUMBERS or type(ended) not in FLAGS or type(cut) not in FLAGS:
                check_step(env, actions[i], result)
            reward[i], terminated[i], truncated[i] = gained, ended, cut
            try:
                write(i, obs)
            except WRONG as error:
                raise misshapen(env, "step", error) from error
            if infos is not None:
                infos.write(i, info)
        if self.reseed:
            self._taken.append(actions)
        if len(self._taken) > LONGEST:
            self._give_up()
        self._stepped = True
        totals.count()
        if self.clip_rewards:
            np.clip(totals.reward, -1.0, 1.0, out=totals.reward)
        self._fresh.copy_from(self._next)
        done = totals.terminated | totals.truncated
        if done.any():
            for i in np.flatnonzero(done):
                self._begin(i)
        return self._result

    def state_dict(self) -> dict[str, Any]:
        """Of every environment the number of its episode and the actions since that began."""
        rows = [
            {
                "episode": int(self._episode[i] + self._endless[i]),
                "actions": np.array([] if self._endless[i] else [actions[i] for actions in self._taken[since:]]),
            }
            for i, since in enumerate(self._since)
        ]
        return {"seed": self.seed, "rows": rows}

    def load_state_dict(self, state: dict[str, Any]) -> Entries:
        """Restores every environment by replaying the actions of its current episode, or begins new ones."""
        if "rows" not in state:  # they are lost: episodes with a number that none has had
            self._restart(self.seed)
            self._episode[:] = state["steps"]
            return self.reset()
        self._restart(state["seed"])
        if not self.reseed:
            self._episode[:] = [row["episode"] for row in state["rows"]]
            return self.reset()
        history = [row["actions"] for row in state["rows"]]
        for i, (env, row) in enumerate(zip(self.envs, state["rows"], strict=True)):
            self._episode[i] = max(row["episode"], 0) - 1
            self._begin(i)
            self._totals.step_count[i] = 0
            for action in row["actions"]:
                try:
                    obs, reward, *_ = env.step(action.copy())
                except FAILURES as error:
                    self._fail(i, error)
                self._write(i, obs, "step")
                self._totals.episode_reward[i] += np.float32(reward)
                self._totals.step_count[i] += 1
                self._begun[i] = False
        longest = max(history, key=len)
        taken = np.zeros((len(longest), self.num_envs, *longest.shape[1:]), longest.dtype)
        self._since = np.array([len(longest) - len(actions) for actions in history])
        for i, actions in enumerate(history):
            if len(actions):
                taken[self._since[i] :, i] = actions
        self._taken = list(taken)
        return self._fresh.tensors

    def close(self) -> None:
        """Closes every environment."""
        for env in self.envs:
            env.close()
