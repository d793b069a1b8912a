"""VMAS's environments (Bettini et al., 2022, https://arxiv.org/abs/2207.03530), a batch of them on one device."""

from __future__ import annotations

import difflib
from types import TracebackType
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor
from torchrl.data import Composite

from pgkit.envs.agents import Group, Names, groups_of, rewards, under
from pgkit.envs.failures import FAILURES, fail, in_vector
from pgkit.envs.numpy_entries import flags
from pgkit.envs.seeding import episode_seed
from pgkit.envs.spaces import to_env
from pgkit.envs.vmas_state import Slot, put, slots
from pgkit.errors import UserError
from pgkit.seams import Entries, Step

ELSEWHERE = frozenset({
    "joint_passage", "road_traffic", "simple_adversary", "simple_push", "simple_reference", "simple_speaker_listener",
    "asym_joint", "circle_trajectory", "line_trajectory",
})  # fmt: skip
"""Scenarios that keep some of their state outside tensors ``[N, ...]``: a goal for the whole batch, a target object."""


class Vmas:
    """A :class:`~pgkit.seams.Simulator` of a VMAS scenario: agents as groups, one end for all of them.

    Environments that end begin anew together: all are reset, and those that go on get their state back. All of VMAS's
    environments share one stream of random numbers; each of these has its own, so that an evaluation changes nothing.
    VMAS's ``max_steps`` would terminate; here a time limit truncates.

    Scenarios of a user's own, and those in ``ELSEWHERE``, are reset one environment after the other, and a resume
    begins new episodes.

    Args:
        scenario: a name, or a ``vmas.simulator.scenario.BaseScenario``.
        num_envs: number of environments.
        seed: of their random numbers.
        device: where they are.
        max_episode_steps: time limit; None: none.
        groups: names of agents by the name of their group; None: one, or by their names where their spaces differ.
        **kwargs: passed to ``vmas.make_env``, which gives what it does not know to the scenario.

    Raises:
        UserError: VMAS is not installed, there is no such scenario, or the spaces do not fit.
    """

    masks = False

    def __init__(
        self,
        scenario: Any,
        num_envs: int,
        seed: int = 0,
        device: torch.device | str | None = None,
        max_episode_steps: int | None = 100,
        groups: Names | None = None,
        **kwargs: Any,
    ) -> None:
        if "max_steps" in kwargs:
            raise UserError("max_steps= would end episodes as if they had failed: max_episode_steps= cuts them off")
        self.num_envs, self.device, self.limit = num_envs, torch.device(device or "cpu"), max_episode_steps
        known = isinstance(scenario, str) and scenario not in ELSEWHERE
        self.resume: Literal["exact", "new episodes"] = "exact" if known else "new episodes"
        self._steps = 0
        self._make = {"scenario": scenario, "num_envs": num_envs, "device": self.device, **kwargs}
        self._restart(seed)
        names = [agent.name for agent in self.env.agents]
        observed = [gym.spaces.Box(-np.inf, np.inf, x.shape[1:], np.float32) for x in self._observed()]
        acted = [_space(space, self.env.continuous_actions) for space in self.env.action_space]
        kind, n = f"vmas/{scenario}" if isinstance(scenario, str) else type(scenario).__name__, num_envs
        spaces = (dict(zip(names, x, strict=True)) for x in (observed, acted))
        self.groups = groups_of(kind, *spaces, groups)
        self._places = {g.name: [names.index(agent) for agent in g.members] for g in self.groups}
        self.observation_spec = under(self.groups, n, {g.name: g.observation_spec(n) for g in self.groups})
        self.action_spec = under(self.groups, n, {g.name: {"action": g.action_spec(n)} for g in self.groups})
        self.reward_spec, self.done_spec, self.info_spec = rewards(self.groups, n), flags(n), Composite(shape=(n,))
        specs = (self.observation_spec, self.action_spec, self.reward_spec, self.done_spec, self.info_spec)
        self.observation_spec, self.action_spec, self.reward_spec, self.done_spec, self.info_spec = (
            spec.to(self.device) for spec in specs
        )
        self.to_env = to_env(self.groups[0].action)
        self._bounds = {g.name: _bounds(g, self.device) for g in self.groups}
        self._begin_counts()

    def _restart(self, seed: int) -> None:
        self.seed = seed
        make, self._stream = _vmas(self._make["scenario"])
        with self._stream:
            try:
                self.env = make(**self._make, seed=seed)
            except TypeError as error:
                if "argument" not in str(error):
                    raise
                raise UserError(f"vmas/{self._make['scenario']} cannot be made with these settings: {error}") from error

    def _begin_counts(self) -> None:
        self.episode_reward: Entries = {
            (g.name, "reward"): torch.zeros(self.num_envs, len(g.members), 1, device=self.device) for g in self.groups
        }
        self.step_count = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self._begun = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self._fresh = self._grouped(self._observed(), "observation")

    def _observed(self) -> list[Tensor]:
        """Every agent's observation ``[N, *obs]``."""
        with self._stream:
            return self.env.get_from_scenario(
                get_observations=True, get_rewards=False, get_infos=False, get_dones=False
            )[0]

    def _grouped(self, agents: list[Tensor], name: str) -> Entries:
        """The agents' tensors ``[N, ...]`` as the groups' ``[N, A, ...]``."""
        return {(group, name): torch.stack([agents[i] for i in own], 1) for group, own in self._places.items()}

    @torch.inference_mode(False)
    @torch.no_grad()
    def reset(self, seed: int | None = None, rows: Tensor | None = None) -> Entries:
        """As :meth:`pgkit.seams.Simulator.reset`."""
        if seed is not None:
            self._restart(seed)
            self._begin_counts()
        again = ~self._begun if rows is None else rows & ~self._begun
        if again.any():
            self._fresh = self._begin(again)
        return self._fresh

    def _begin(self, rows: Tensor) -> Entries:
        """New episodes in these rows; what the policy reads next, everywhere."""
        together = bool(rows.all()) or self.resume == "exact"
        before = {} if rows.all() or not together else {path: x.clone() for path, _, _, x in self._batched()}
        with self._stream:
            if together:
                self.env.reset(return_observations=False)
            for i in [] if together else rows.nonzero().flatten().tolist():
                self.env.reset_at(i, return_observations=False)
        for slot in self._batched() if before else []:
            path, _, _, fresh = slot
            if path in before:
                put(slot, torch.where(rows.view(-1, *[1] * (fresh.ndim - 1)), fresh, before[path]))
        self._begun = self._begun | rows
        return self._grouped(self._observed(), "observation")

    def _batched(self) -> list[Slot]:
        """Where the state of the environments lies: tensors ``[N, ...]``."""
        return [x for x in slots(self.env) if isinstance(x[-1], Tensor) and x[-1].shape[:1] == (self.num_envs,)]

    @torch.inference_mode(False)
    @torch.no_grad()
    def step(self, action: Entries) -> Step:
        """As :meth:`pgkit.seams.Simulator.step`; continuous actions are clipped to their bounds first."""
        actions: list[Any] = [None] * len(self.env.agents)
        for group, own in self._places.items():
            x = action[group, "action"]
            bounds = self._bounds[group]
            x = x if bounds is None else x.clamp(*bounds)
            for i, agent in zip(own, x.unbind(1), strict=True):
                actions[i] = agent.clone()
        try:
            with self._stream:
                observed, rewarded, terminated, _ = self.env.step(actions)
        except FAILURES as error:
            fail(in_vector(self.env.scenario, 0, self.num_envs, self._steps + 1, self.seed), error)
        self._steps += 1
        reward = self._grouped([x.view(-1, 1) for x in rewarded], "reward")
        goes_on = ~self._begun
        self.step_count = self.step_count * goes_on + 1
        self.episode_reward = {
            key: before * goes_on.view(-1, 1, 1) + reward[key] for key, before in self.episode_reward.items()
        }
        cut = self.step_count >= self.limit if self.limit is not None else torch.zeros_like(terminated)
        self._begun = torch.zeros_like(cut)
        after, ended = self._grouped(observed, "observation"), terminated | cut
        self._fresh = self._begin(ended) if ended.any() else after
        ends = ({"terminated": terminated.view(-1, 1)}, {"truncated": cut.view(-1, 1)})
        return Step(after, reward, *ends, {}, self._fresh)

    def state_dict(self) -> dict[str, Any]:
        """Every number and tensor that VMAS's objects hold, and the state of the random numbers, where that is all."""
        state = {"seed": self.seed, "steps": self._steps}
        if self.resume == "new episodes":
            return state
        held = {path: x.clone() if isinstance(x, Tensor) else x for path, _, _, x in slots(self.env)}
        counts = {"step_count": self.step_count, "begun": self._begun}
        return state | {
            "held": held,
            "random": list(self._stream.state),
            "counts": {name: x.clone() for name, x in counts.items()},
            "returns": [x.clone() for x in self.episode_reward.values()],
        }

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Any]) -> Entries:
        """Goes on exactly, or begins new episodes with a seed of their own."""
        exact, seed = self.resume == "exact" and "held" in state, state.get("seed", self.seed)
        self._restart(seed if exact or not state["steps"] else episode_seed(seed, 0, state["steps"]))
        self.seed = seed
        if not exact:
            self._begin_counts()
            self._steps = state["steps"]
            return self._fresh
        zeros = {(g.name, "action"): self.action_spec[g.name, "action"].zero() for g in self.groups}
        self._begin_counts()
        self.step(zeros)  # makes what VMAS makes at the first step
        for slot in slots(self.env):
            if slot[0] in state["held"]:
                put(slot, state["held"][slot[0]])
        self._stream.state[:] = state["random"]
        self._steps = state["steps"]
        self.step_count, self._begun = (state["counts"][name].to(self.device) for name in ("step_count", "begun"))
        self.episode_reward = dict(zip(self.episode_reward, state["returns"], strict=True))
        self._fresh = self._grouped(self._observed(), "observation")
        return self._fresh

    def close(self) -> None:
        """Nothing is open: VMAS has no windows unless it is asked to draw."""


class _Stream:
    """``with stream:`` VMAS draws from this object's random numbers; its class has a list with the state for all."""

    def __init__(self, shared: list[Any]) -> None:
        self._shared, self.state = shared, list(shared)

    def __enter__(self) -> None:
        self._others = list(self._shared)
        self._shared[:] = self.state

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.state = list(self._shared)
        self._shared[:] = self._others


def _vmas(scenario: Any) -> tuple[Any, _Stream]:
    """VMAS's function that makes an environment, and a stream of random numbers."""
    try:
        import vmas
        from vmas.simulator.environment import Environment
    except ImportError as error:
        raise UserError(f'vmas/{scenario} needs VMAS ({error}): pip install "pgkit-rl[agents]"') from error
    known = [*vmas.scenarios, *vmas.debug_scenarios, *vmas.mpe_scenarios]
    if isinstance(scenario, str) and scenario not in known:
        nearest = ", ".join(f"vmas/{x}" for x in difflib.get_close_matches(scenario, known, cutoff=0.4) or known)
        raise UserError(f"unknown environment id 'vmas/{scenario}'; the nearest names are {nearest}")
    return vmas.make_env, _Stream(Environment.vmas_random_state)


def _space(space: Any, continuous: bool) -> gym.Space:
    """A space of the old Gym, which VMAS still has, as Gymnasium's."""
    if continuous:
        return gym.spaces.Box(space.low, space.high, dtype=np.float32)
    return gym.spaces.Discrete(int(space.n))


def _bounds(group: Group, device: torch.device) -> tuple[Tensor, Tensor] | None:
    if not isinstance(group.action, gym.spaces.Box):
        return None
    return torch.as_tensor(group.action.low, device=device), torch.as_tensor(group.action.high, device=device)
