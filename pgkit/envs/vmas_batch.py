"""VMAS's environments (Bettini et al., 2022, https://arxiv.org/abs/2207.03530), a batch of them on one device."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor
from torchrl.data import Composite

from pgkit.compiled import Mode
from pgkit.envs.agents import Group, Names, groups_of, rewards, under
from pgkit.envs.failures import FAILURES, fail, in_vector
from pgkit.envs.held import Slot, put
from pgkit.envs.numpy_entries import flags
from pgkit.envs.recorded import Function, Native, Recorded, falls_back, record
from pgkit.envs.seeding import episode_seed
from pgkit.envs.spaces import to_env
from pgkit.envs.vmas_state import Stream, make_function, slots
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
        compile: ``auto`` records step and reset, and compiles what it recorded (a few seconds, kept on disk); what
            cannot be recorded runs as it is, and the log says why. ``on``: then it is a ``UserError``. ``record``:
            without a compiler. ``off``: as it is.
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
        compile: Mode = "off",
        **kwargs: Any,
    ) -> None:
        if "max_steps" in kwargs:
            raise UserError("max_steps= would end episodes as if they had failed: max_episode_steps= cuts them off")
        self.num_envs, self.device, self.limit = num_envs, torch.device(device or "cpu"), max_episode_steps
        known = isinstance(scenario, str) and scenario not in ELSEWHERE
        self.resume: Literal["exact", "new episodes"] = "exact" if known else "new episodes"
        self._steps = 0
        self._make = {"scenario": scenario, "num_envs": num_envs, "device": self.device, **kwargs}
        self._recorded: dict[str, Recorded] = {}
        self._restart(seed)
        names = [agent.name for agent in self.env.agents]
        with self._stream:
            shapes = [x.shape[1:] for x in self._observed()]
        observed = [gym.spaces.Box(-np.inf, np.inf, shape, np.float32) for shape in shapes]
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
        if compile != "off":
            with falls_back(kind, compile):
                self._recorded = self._twin(groups).recorded(compile, kind)
        self._begin_native()

    def _twin(self, groups: Names | None) -> Vmas:
        given = {**self._make, "scenario": copy.deepcopy(self._make["scenario"])}
        return Vmas(seed=self.seed, max_episode_steps=self.limit, groups=groups, **given)

    def _restart(self, seed: int) -> None:
        self.seed = seed
        make = make_function(self._make["scenario"])
        try:
            self.env, self._stream = Stream.of(partial(make, **self._make, seed=seed))
        except TypeError as error:
            if "argument" not in str(error):
                raise
            raise UserError(f"vmas/{self._make['scenario']} cannot be made with these settings: {error}") from error
        self._begin_native()

    def recorded(self, mode: Mode, kind: str) -> dict[str, Recorded]:
        """Step and reset as native code, where they can be recorded; this object is the record's own from then on."""
        if isinstance(self._make["scenario"], str) and self._make["scenario"] in ELSEWHERE:
            raise RuntimeError("it keeps some of its state outside of tensors")

        def play(advance: Function, renew: Function) -> None:
            actions = [self.action_spec[g.name, "action"] for g in self.groups]
            self.advance(*[spec.rand() for spec in actions])  # makes what VMAS makes at the first step
            for step in range(40):
                if step % 8 == 0:
                    renew(torch.rand(self.num_envs, device=self.device) < (1.0, 0.3)[step > 0])
                advance(*[spec.rand() for spec in actions])

        with self._stream:
            return record((self.advance, self.renew), self.held, play, self.num_envs, mode, kind)

    @property
    def recorded_parts(self) -> list[str]:
        """What runs as native code: ``advance``, the step, and ``renew``, the resets."""
        return list(self._recorded)

    def _begin_native(self) -> None:
        self._stepped = False  # VMAS makes some of its tensors at the first step
        self._native = Native(self._recorded, self.held, str(self._make["scenario"])) if self._recorded else None

    def _call(self, function: Function, *inputs: Tensor) -> Sequence[Tensor]:
        return self._native(function, *inputs) if self._native and self._stepped else function(*inputs)

    def _begin_counts(self) -> None:
        self.episode_reward: Entries = {
            (g.name, "reward"): torch.zeros(self.num_envs, len(g.members), 1, device=self.device) for g in self.groups
        }
        self.step_count = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self._begun = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        with self._stream:
            self._fresh = self._named(self.see())

    def _observed(self) -> list[Tensor]:
        """Every agent's observation ``[N, *obs]``."""
        return self.env._get_from_scenario(get_observations=True, get_rewards=False, get_infos=False, get_dones=False)[
            0
        ]

    def see(self) -> list[Tensor]:
        """The groups' observations ``[N, A, *obs]``."""
        return list(self._grouped(self._observed(), "observation").values())

    def _grouped(self, agents: Sequence[Tensor], name: str) -> Entries:
        """The agents' tensors ``[N, ...]`` as the groups' ``[N, A, ...]``."""
        return {(group, name): torch.stack([agents[i] for i in own], 1) for group, own in self._places.items()}

    def held(self) -> list[Slot]:
        """Everything that VMAS's objects hold."""
        return slots(self.env)

    def advance(self, *actions: Tensor) -> list[Tensor]:
        """VMAS's own step with the groups' actions ``[N, A, ...]``: their observations, their rewards, and the end.

        It draws from torch's generator.
        """
        given: list[Any] = [None] * len(self.env.agents)
        for x, (group, own) in zip(actions, self._places.items(), strict=True):
            bounds = self._bounds[group]
            x = x if bounds is None else x.clamp(*bounds)
            for i, agent in zip(own, x.unbind(1), strict=True):
                given[i] = agent.clone()
        observed, rewarded, terminated, _ = type(self.env).step.__wrapped__(self.env, given)
        rewards = self._grouped([x.view(-1, 1) for x in rewarded], "reward")
        return [*self._grouped(observed, "observation").values(), *rewards.values(), terminated]

    def renew(self, rows: Tensor) -> list[Tensor]:
        """New episodes where ``rows [N]`` is set, all drawn together; the groups' observations."""
        before = {path: x.clone() for path, _, _, x in self._batched()}
        self.env._reset(return_observations=False)
        for slot in self._batched():
            path, _, _, fresh = slot
            if path in before:
                put(slot, torch.where(rows.view(-1, *[1] * (fresh.ndim - 1)), fresh, before[path]))
        return self.see()

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
        self._begun = self._begun | rows
        with self._stream:
            if self.resume == "exact" or bool(rows.all()):
                found = self._call(self.renew, rows)
            else:
                for i in rows.nonzero().flatten().tolist():
                    self.env._reset_at(i, return_observations=False)
                found = self._call(self.see)
        return self._named(found)

    def _named(self, observed: Iterable[Tensor]) -> Entries:
        return {(g.name, "observation"): x for g, x in zip(self.groups, observed, strict=False)}

    def _batched(self) -> list[Slot]:
        """Where the state of the environments lies: tensors ``[N, ...]``."""
        return [x for x in slots(self.env) if isinstance(x[-1], Tensor) and x[-1].shape[:1] == (self.num_envs,)]

    @torch.inference_mode(False)
    @torch.no_grad()
    def step(self, action: Entries) -> Step:
        """As :meth:`pgkit.seams.Simulator.step`; continuous actions are clipped to their bounds first."""
        try:
            with self._stream:
                made = self._call(self.advance, *[action[g.name, "action"] for g in self.groups])
        except FAILURES as error:
            fail(in_vector(self.env.scenario, 0, self.num_envs, self._steps + 1, self.seed), error)
        self._stepped = True
        self._steps += 1
        count = len(self.groups)
        after, terminated = self._named(made), made[-1]
        reward = dict(zip(self.episode_reward, made[count:], strict=False))
        goes_on = ~self._begun
        self.step_count = self.step_count * goes_on + 1
        self.episode_reward = {
            key: before * goes_on.view(-1, 1, 1) + reward[key] for key, before in self.episode_reward.items()
        }
        cut = self.step_count >= self.limit if self.limit is not None else torch.zeros_like(terminated)
        self._begun = torch.zeros_like(cut)
        ended = terminated | cut
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
        returns = [x.to(self.device) for x in state["returns"]]
        self.episode_reward = dict(zip(self.episode_reward, returns, strict=True))
        with self._stream:
            self._fresh = self._named(self.see())
        return self._fresh

    def close(self) -> None:
        """Nothing is open: VMAS has no windows unless it is asked to draw."""


def _space(space: Any, continuous: bool) -> gym.Space:
    """A space of the old Gym, which VMAS still has, as Gymnasium's."""
    if continuous:
        return gym.spaces.Box(space.low, space.high, dtype=np.float32)
    return gym.spaces.Discrete(int(space.n))


def _bounds(group: Group, device: torch.device) -> tuple[Tensor, Tensor] | None:
    if not isinstance(group.action, gym.spaces.Box):
        return None
    return torch.as_tensor(group.action.low, device=device), torch.as_tensor(group.action.high, device=device)
