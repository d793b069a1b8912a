"""PettingZoo's parallel environments (Terry et al., 2021, https://arxiv.org/abs/2009.14471), stepped one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor
from torchrl.data import Categorical, Composite

from pgkit.envs.agents import Names, groups_of, rewards, under
from pgkit.envs.checks import WRONG, misshapen
from pgkit.envs.failures import FAILURES, LONGEST, fail, in_episode, warn_of_length
from pgkit.envs.numpy_entries import flags
from pgkit.envs.seeding import episode_seed
from pgkit.envs.spaces import to_env
from pgkit.envs.teams import Team
from pgkit.errors import UserError
from pgkit.seams import Entries, Key, Step


@runtime_checkable
class ParallelEnv(Protocol):
    """What PettingZoo's parallel API has: all agents act at once, in dicts by their names."""

    possible_agents: list[str]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, Any], dict[str, Any]]: ...

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]: ...

    def observation_space(self, agent: str) -> gym.Space: ...

    def action_space(self, agent: str) -> gym.Space: ...


class Parallel:
    """A :class:`~pgkit.seams.Simulator` of PettingZoo's parallel environments in this process, on NumPy.

    A group's entries have the agents' dimension after the environments': ``("agents", "observation") [N, A, ...]``,
    ``("agents", "mask") [N, A]``, False where an agent is gone; its observation and reward are then 0. Each agent's
    ``("agents", "terminated")`` stays set once it is gone; the flags at the root say that an episode ended for all:
    ``truncated`` where an agent was cut off, else ``terminated``. Seeds and :meth:`state_dict` are as
    :class:`~pgkit.envs.Gymnasium`'s: episodes are replayed, bit for bit.

    Args:
        envs: the environments.
        seed: the run's seed.
        first: index of the first one, where this is a share of a larger vector.
        groups: names of agents by the name of their group; None: one, or by their names where their spaces differ.
        reseed, options: as for :class:`~pgkit.envs.Gymnasium`.
    """

    device = torch.device("cpu")
    masks = False

    def __init__(
        self,
        envs: Sequence[ParallelEnv],
        seed: int = 0,
        first: int = 0,
        groups: Names | None = None,
        reseed: bool = True,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        if len({id(env) for env in envs}) < len(envs):
            raise UserError("the function that makes an environment gave the same one twice: it must make a new one")
        self.envs: Sequence[Any] = envs
        self.reseed, self.options = reseed, None if options is None else dict(options)
        self.resume: Literal["exact", "new episodes"] = "exact" if reseed else "new episodes"
        self.num_envs, self.first, one, n = len(envs), first, envs[0], len(envs)
        spaces = ({a: space(a) for a in one.possible_agents} for space in (one.observation_space, one.action_space))
        self.groups = groups_of(type(one).__name__, *spaces, groups)
        flag = {name: Categorical(2, (n, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        observed, ends = {}, {}
        for g in self.groups:
            size = (n, len(g.members))
            present = Categorical(2, size, dtype=torch.bool)
            observed[g.name] = {**g.observation_spec(n), "mask": present}
            ends[g.name] = {name: Categorical(2, (*size, 1), dtype=torch.bool) for name in flag}
        self.observation_spec = under(self.groups, n, observed)
        self.action_spec = under(self.groups, n, {g.name: {"action": g.action_spec(n)} for g in self.groups})
        self.reward_spec, self.info_spec = rewards(self.groups, n), Composite(shape=(n,))
        self.done_spec = flags(n)
        self.done_spec.update(under(self.groups, n, ends))
        self.to_env = to_env(self.groups[0].action)
        self._teams = [Team(g, n) for g in self.groups]
        self._terminated, self._truncated = np.zeros((n, 1), bool), np.zeros((n, 1), bool)
        self._steps, self._result = np.zeros(n, np.int64), self._as_step()
        self.step_count = torch.from_numpy(self._steps)
        self._warned = False
        self._restart(seed)

    def _as_step(self) -> Step:
        """The arrays, as the tensors of a step."""
        teams = self._teams
        self.episode_reward: Entries = {(t.name, "reward"): torch.from_numpy(t.total) for t in teams}
        ends: dict[Key, Tensor] = {"terminated": torch.from_numpy(self._terminated)}
        cuts: dict[Key, Tensor] = {"truncated": torch.from_numpy(self._truncated)}
        ends |= {(t.name, "terminated"): torch.from_numpy(t.terminated) for t in teams}
        cuts |= {(t.name, "truncated"): torch.from_numpy(t.truncated) for t in teams}
        self._fresh: Entries = {k: x for t in teams for k, x in t.fresh.tensors.items()}
        following: Entries = {k: x for t in teams for k, x in t.next.tensors.items()}
        return Step(
            following, {(t.name, "reward"): torch.from_numpy(t.reward) for t in teams}, ends, cuts, {}, self._fresh
        )

    def _restart(self, seed: int) -> None:
        self.seed = seed
        self._begun = np.zeros(self.num_envs, bool)  # the episode was begun and has not been stepped since
        self._seeds: list[int | None] = [None] * self.num_envs  # of the running episodes
        self._seeded = np.zeros(self.num_envs, bool)
        self._episode = np.full(self.num_envs, -1)
        self._taken: list[list[list[np.ndarray]]] = [[] for _ in self.envs]  # actions of the running episodes
        self._endless = np.zeros(self.num_envs, bool)  # whose episode is too long to be replayed

    def reset(self, seed: int | None = None, rows: Tensor | None = None) -> Entries:
        """As :meth:`pgkit.seams.Simulator.reset`."""
        if seed is not None:
            self._restart(seed)
        for i in range(self.num_envs) if rows is None else np.flatnonzero(rows.numpy()):
            if not self._begun[i]:
                self._begin(int(i))
        return self._fresh

    def _begin(self, i: int) -> None:
        self._episode[i] += 1
        given: dict[str, Any] = {} if self.options is None else {"options": dict(self.options)}
        if self.reseed or not self._seeded[i]:
            given["seed"] = episode_seed(self.seed, self.first + i, int(self._episode[i]))
            self._seeded[i] = True
        self._seeds[i] = given.get("seed")
        try:
            result = self.envs[i].reset(**given)
        except FAILURES as error:
            fail(in_episode(self.envs[i], self.first + i, 0, self._seeds[i]), error)
        if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[0], dict):
            raise UserError(
                f"{type(self.envs[i]).__name__}.reset returned a {type(result).__name__}: return (observations, "
                "infos), dicts by the agents' names"
            )
        self._observe("reset", i, result[0], self.envs[i].agents)
        self._begun[i], self._taken[i], self._endless[i] = True, [], False

    def step(self, action: Entries) -> Step:
        """As :meth:`pgkit.seams.Simulator.step`; Box actions are clipped to their bounds first."""
        if self._begun.any():
            self._steps[self._begun] = 0
            for team in self._teams:
                team.total[self._begun] = 0
            self._begun[:] = False
        actions = [team.to_env(action[team.name, "action"].numpy()) for team in self._teams]
        for i in range(self.num_envs):
            given = [x[i] for x in actions]
            self._one_step(i, given)
            if self.reseed:
                self._keep(i, given)
        for team in self._teams:
            team.fresh.copy_from(team.next)
        for i in np.flatnonzero(self._terminated | self._truncated):
            self._begin(int(i))
        return self._result

    def _keep(self, i: int, actions: list[np.ndarray]) -> None:
        """Keeps the actions for a resume, unless the episode has become too long."""
        self._taken[i].append(actions)
        if len(self._taken[i]) > LONGEST:
            if not self._warned:
                self._warned = True
                warn_of_length(self.envs[i], self.first + i)
            self._endless[i], self._taken[i] = True, []

    def _one_step(self, i: int, actions: list[np.ndarray]) -> None:
        """Steps one environment with the groups' actions ``[A, ...]`` and writes its row."""
        env = self.envs[i]
        given = {
            name: x[place].copy() for team, x in zip(self._teams, actions, strict=True)
            for place, name in enumerate(team.members) if name in env.agents
        }  # fmt: skip
        acting = set(given)
        try:
            result = env.step(given)
        except FAILURES as error:
            fail(in_episode(env, self.first + i, int(self._steps[i]) + 1, self._seeds[i]), error)
        if not isinstance(result, tuple) or len(result) != 5:
            raise UserError(
                f"{type(env).__name__}.step returned no tuple of 5: return (observations, rewards, terminations, "
                "truncations, infos), dicts by the agents' names"
            )
        observations, reward, terminated, truncated, _ = result
        self._check(env, acting, result)
        over = not env.agents or all(terminated.get(x) or truncated.get(x) for x in env.agents)
        cut = over and any(truncated.get(x) and not terminated.get(x) for x in acting)
        self._truncated[i], self._terminated[i] = cut, over and not cut
        present = [x for x in env.agents if not (terminated.get(x) or truncated.get(x))]
        self._observe("step", i, observations, present)
        for team in self._teams:
            team.write(env, i, acting, reward, terminated, truncated)
        self._steps[i] += 1

    def _observe(self, method: str, i: int, observations: dict[str, Any], present: Sequence[str]) -> None:
        for team in self._teams:
            try:
                team.observe(team.next if method == "step" else team.fresh, i, observations, present)
            except WRONG as error:
                raise misshapen(self.envs[i], method, error) from error

    def _check(self, env: Any, acting: set[str], result: tuple[Any, ...]) -> None:
        """A ``UserError`` for what is no dict of the agents that acted."""
        for what, x in zip(("observations", "rewards", "terminations", "truncations"), result, strict=False):
            missing = acting - x.keys() if isinstance(x, dict) else acting
            if missing:
                raise UserError(
                    f"{type(env).__name__}.step returned no {what} of agent '{min(missing)}', which acted: return a "
                    "dict with all agents that acted"
                )

    def state_dict(self) -> dict[str, Any]:
        """Of every environment the number of its episode and the actions since that began, by group."""
        rows = []
        for episode, taken, endless in zip(self._episode, self._taken, self._endless, strict=True):
            columns = zip(*taken, strict=True) if taken and not endless else [[] for _ in self._teams]
            rows.append({"episode": int(episode) + endless, "actions": [np.array(list(x)) for x in columns]})
        return {"seed": self.seed, "rows": rows}

    def load_state_dict(self, state: dict[str, Any]) -> Entries:
        """Restores every environment by replaying the actions of its current episode."""
        if "rows" not in state:  # they are lost: episodes with a number that none has had
            self._restart(self.seed)
            self._episode[:] = state["steps"]
            return self.reset()
        self._restart(state["seed"])
        if not self.reseed:
            self._episode[:] = [row["episode"] for row in state["rows"]]
            return self.reset()
        for i, row in enumerate(state["rows"]):
            self._episode[i] = max(row["episode"], 0) - 1
            self._begin(i)
            self._steps[i] = 0
            for team in self._teams:
                team.total[i] = 0
            for actions in zip(*row["actions"], strict=True):
                self._one_step(i, list(actions))
                self._taken[i].append(list(actions))
                self._begun[i] = False
            for team in self._teams if len(row["actions"][0]) else []:
                team.fresh.copy_row(team.next, i)
        return self._fresh

    def close(self) -> None:
        """Closes every environment."""
        for env in self.envs:
            env.close()


def is_parallel(env: Any) -> bool:
    """Whether it has PettingZoo's parallel API."""
    return isinstance(env, ParallelEnv)


@runtime_checkable
class _InTurns(Protocol):
    """What PettingZoo's AEC API has: the agents act one after the other."""

    def agent_iter(self, max_iter: int = 2**63) -> Any: ...


def refuse_turns(env: Any) -> None:
    """A ``UserError`` for an AEC environment."""
    if isinstance(env, _InTurns):
        raise UserError(
            f"{type(env).__name__} is an AEC environment, whose agents act in turns: if they may act at once, give "
            "envs.make a function that makes pettingzoo.utils.aec_to_parallel(env)"
        )
