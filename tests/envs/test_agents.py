"""Many agents: PettingZoo's parallel environments and VMAS as simulators; groups, masks, ends, resume, mistakes."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import check_env_specs

from pgkit import collectors, envs, modules
from pgkit.envs.parallel import Parallel
from pgkit.errors import UserError
from tests.collectors.test_vector import equal


class Fading(ParallelEnv):
    """The first agent dies after 2 steps, the other is cut off after 4; each observes (step, its number)."""

    metadata = {"name": "fading"}
    possible_agents = ["walker_0", "walker_1"]

    def __init__(self, limit: int = 4, dies: int = 2) -> None:
        self.limit, self.dies = limit, dies

    def observation_space(self, agent: str) -> gym.Space:
        return spaces.Box(-9, 9, (2,))

    def action_space(self, agent: str) -> gym.Space:
        return spaces.Box(-1, 1, (1,))

    def _observe(self) -> dict[str, Any]:
        return {x: np.array([self.t + self.noise, i], np.float32) for i, x in enumerate(self.possible_agents)}

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.t = list(self.possible_agents), 0
        self.noise = np.random.default_rng(seed).uniform(0, 0.5)
        return self._observe(), {x: {} for x in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        assert set(actions) == set(self.agents)
        self.t += 1
        seen = {x: o for x, o in self._observe().items() if x in actions}
        reward = {x: float(a[0]) for x, a in actions.items()}
        dead = {x: x == self.possible_agents[0] and self.t == self.dies for x in actions}
        cut = {x: self.t == self.limit and not dead[x] for x in actions}
        self.agents = [x for x in self.agents if not (dead[x] or cut[x])]
        return seen, reward, dead, cut, {x: {} for x in actions}


class Unlike(Fading):
    """``speaker_0`` chooses among 3 with a mask, ``listener_0`` moves."""

    possible_agents = ["speaker_0", "listener_0"]

    def observation_space(self, agent: str) -> gym.Space:
        own = spaces.Box(-9, 9, (2,))
        mask = spaces.Box(0, 1, (3,), np.int8)
        return spaces.Dict(observation=own, action_mask=mask) if agent == "speaker_0" else own

    def action_space(self, agent: str) -> gym.Space:
        return spaces.Discrete(3) if agent == "speaker_0" else spaces.Box(-1, 1, (1,))

    def _observe(self) -> dict[str, Any]:
        mask = np.array([True, False, self.t % 2 == 0], np.int8)
        seen = super()._observe()
        return seen | {"speaker_0": {"observation": seen["speaker_0"], "action_mask": mask}}

    def step(self, actions: dict[str, Any]) -> Any:
        if "speaker_0" in actions:
            assert actions["speaker_0"] in (0, 2) and (actions["speaker_0"] == 0 or self.t % 2 == 0)
        moves = {x: np.atleast_1d(a) for x, a in actions.items()}
        return super().step(moves)


def test_an_agent_that_dies_is_masked_and_the_episode_goes_on():
    simulator = Parallel([Fading(), Fading()], seed=3)
    fresh = {k: x.clone() for k, x in simulator.reset().items()}
    assert fresh["agents", "observation"].shape == (2, 2, 2) and fresh["agents", "mask"].all()
    action = torch.tensor([[[0.5], [-3.0]], [[0.25], [1.0]]])
    masks, dead, cut, rewards, lengths = [], [], [], [], []
    for _ in range(5):
        step = simulator.step({("agents", "action"): action})
        masks.append(step.next["agents", "mask"][0].tolist())
        dead.append([x[0].flatten().tolist() for x in step.terminated.values()])
        cut.append([x[0].flatten().tolist() for x in step.truncated.values()])
        rewards.append(step.reward["agents", "reward"][0, :, 0].tolist())
        lengths.append(int(simulator.step_count[0]))
        if len(masks) == 4:
            totals = simulator.episode_reward["agents", "reward"][..., 0].tolist()
            assert step.fresh["agents", "mask"].all() and step.next["agents", "observation"][0, 1, 0] >= 4
            assert step.fresh["agents", "observation"][0, 1, 0] < 1
    T, F = True, False
    assert masks == [[T, T], [F, T], [F, T], [F, F], [T, T]]
    assert dead == [[[F], [F, F]], [[F], [T, F]], [[F], [T, F]], [[F], [T, F]], [[F], [F, F]]]
    assert cut == [[[F], [F, F]], [[F], [F, F]], [[F], [F, F]], [[T], [F, T]], [[F], [F, F]]]
    assert rewards == [[0.5, -1.0], [0.5, -1.0], [0.0, -1.0], [0.0, -1.0], [0.5, -1.0]]  # clipped to -1
    assert lengths == [1, 2, 3, 4, 1] and totals == [[1.0, -4.0], [0.5, 4.0]]


def both_dead() -> Fading:
    env = Fading(limit=2, dies=2)
    env.possible_agents = ["walker_0"]
    return env


def test_where_all_are_dead_the_episode_terminates():
    simulator = Parallel([both_dead()])
    simulator.reset()
    steps = [simulator.step({("agents", "action"): torch.zeros(1, 1, 1)}) for _ in range(2)]
    assert steps[-1].terminated["terminated"].item() and not steps[-1].truncated["truncated"].item()


def test_unequal_agents_are_groups_of_their_own_and_action_masks_hold():
    check_env_specs(envs.make(Fading, num_envs=2))
    env = envs.make(Unlike, num_envs=3, seed=1)
    assert env.groups == {("speaker",): (1,), ("listener",): (1,)}
    actors = modules.categorical_actor(env, (8,), group="speaker"), modules.gaussian_actor(env, (8,), group="listener")
    collector = collectors.VectorCollector(  # the environment itself refuses an action that is not allowed
        env, TensorDictSequential(*actors), frames_per_batch=60, init_random_frames=1, compile="off"
    )
    for rollout in (collector.rollout(), collector.rollout()):
        mask = rollout["speaker", "action_mask"].clone()
        alive = rollout["speaker", "mask"]
        assert rollout["speaker", "action"].shape == (3, 20, 1) and alive.any() and not alive.all()
        assert mask.gather(-1, rollout["speaker", "action"].unsqueeze(-1))[alive].all() and not mask[alive].all()
        assert rollout["next", "done"].shape == (3, 20, 1)
        assert rollout["next", "listener", "done"].shape == (3, 20, 1, 1)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_resume_replays_and_workers_change_nothing(workers: int):
    def collector(workers: int = 1) -> Any:
        torch.manual_seed(0)
        env = envs.make(Fading, num_envs=4, seed=5, workers=workers)
        actor = modules.gaussian_actor(env, (8,))
        return collectors.VectorCollector(env, actor, frames_per_batch=4 * 7, compile="off")

    straight, other = collector(), collector(workers)
    first, expected = straight.rollout(), straight.rollout()
    assert equal(other.rollout(), first)
    state, again = other.state_dict(), collector(workers)
    other.shutdown()
    again.load_state_dict(state)
    assert equal(again.rollout(), expected)
    again.shutdown()


def balance(seed: int = 1, name: str = "balance", **kwargs: Any) -> envs.VectorEnv:
    return envs.make(f"vmas/{name}", num_envs=5, seed=seed, max_episode_steps=6, **kwargs)


def steps(simulator: Any, count: int, seed: int = 0) -> list[Any]:
    draw, shape = torch.Generator().manual_seed(seed), simulator.action_spec["agents", "action"].shape
    return [simulator.step({("agents", "action"): 2 * torch.rand(shape, generator=draw) - 1}) for _ in range(count)]


def same(a: list[Any], b: list[Any]) -> bool:
    key, pay = ("agents", "observation"), ("agents", "reward")
    return all(
        torch.equal(x.fresh[key], y.fresh[key]) and torch.equal(x.reward[pay], y.reward[pay])
        for x, y in zip(a, b, strict=True)
    )


def test_vmas_is_cut_off_by_its_time_limit_and_its_agents_are_one_group():
    env = balance(n_agents=4)
    check_env_specs(env)
    assert env.groups == {("agents",): (4,)} and env.full_action_spec["agents", "action"].shape == (5, 4, 2)
    env.simulator.reset()
    made = steps(env.simulator, 6)
    assert made[-1].truncated["truncated"].any() and not made[-2].truncated["truncated"].any()
    cut = made[-1].truncated["truncated"][:, 0]
    assert not made[-1].terminated["terminated"][cut].all()
    assert (made[-1].fresh["agents", "observation"] != made[-1].next["agents", "observation"])[cut].any(-1).all()


def test_another_vmas_environment_changes_nothing_and_torchs_generator_stays():
    alone, beside = balance(), balance()
    for env in (alone, beside):
        env.simulator.reset()
    state = torch.get_rng_state()
    expected = steps(alone.simulator, 15)
    found = []
    for step in range(15):
        other = balance(seed=7)
        other.simulator.reset()
        steps(other.simulator, 2)
        draw = torch.Generator().manual_seed(0)
        actions = [2 * torch.rand(5, 3, 2, generator=draw) - 1 for _ in range(step + 1)]
        found.append(beside.simulator.step({("agents", "action"): actions[-1]}))
    assert same(found, expected) and torch.equal(torch.get_rng_state(), state)
    assert not same(expected, steps(balance(seed=2).simulator, 15))


@pytest.mark.parametrize(("name", "exact"), [("balance", True), ("navigation", True), ("joint_passage", False)])
def test_vmas_resumes_exactly_where_its_state_is_in_tensors(name: str, exact: bool):
    one, other = balance(name=name).simulator, balance(seed=3, name=name).simulator
    for simulator in (one, other):
        simulator.reset()
    steps(one, 8)
    state = one.state_dict()
    other.load_state_dict(state)
    assert one.resume == ("exact" if exact else "new episodes")
    assert same(steps(one, 9, 4), steps(other, 9, 4)) == exact


@pytest.mark.parametrize("name", ["balance", "joint_passage"])
def test_a_reset_of_some_vmas_environments_leaves_the_others(name: str):
    simulator = balance(name=name).simulator
    before = simulator.reset()["agents", "observation"].clone()
    after = steps(simulator, 3)[-1].fresh["agents", "observation"].clone()
    rows = torch.tensor([True, False, True, False, False])
    fresh = simulator.reset(rows=rows)["agents", "observation"]
    assert torch.equal(fresh[~rows], after[~rows]) and not (fresh == after)[rows].all(-1).any()
    assert not torch.equal(fresh[rows], before[rows])
    again = simulator.reset(rows=rows)["agents", "observation"]  # they have just begun
    assert torch.equal(again, fresh)


class Turns(AECEnv):
    """Agents that act one after the other."""

    possible_agents = ["a"]


class Mixed(Unlike):
    possible_agents = ["agent_0", "agent_1"]

    def action_space(self, agent: str) -> gym.Space:
        return spaces.Discrete(3) if agent == "agent_0" else spaces.Box(-1, 1, (1,))


@pytest.mark.parametrize(
    ("make", "settings", "message"),
    [
        (Turns, {}, r"Turns is an AEC environment.*aec_to_parallel\(env\)"),
        (Mixed, {}, "group 'agent': agent_0 and agent_1 act in different spaces .* groups of their own"),
        (Fading, {"groups": {"a": ["walker_0"]}}, "agent 'walker_1' of Fading is in 0 groups"),
        (Fading, {"groups": {"a": ["walker_0", "me"]}}, "Fading has no agent 'me', only walker_0, walker_1"),
        (Fading, {"groups": {"next": ["walker_0", "walker_1"]}}, "the group 'next' has a name that rollouts use"),
        (Fading, {"action_repeat": 2}, "action_repeat= is for single Gymnasium environments, this is a Fading"),
        (Fading, {"frame_stack": 4}, "frame_stack= is for single Gymnasium environments, this is a Fading"),
        ("vmas/balance", {"reseed": False}, "reseed=False is for single Gymnasium environments, this is a Vmas"),
        ("CartPole-v1", {"groups": {"a": ["b"]}}, "groups= is for environments with many agents"),
        ("vmas/balanse", {}, "unknown environment id 'vmas/balanse'; the nearest names are vmas/balance"),
        ("vmas/balance", {"max_steps": 5}, "max_episode_steps= cuts them off"),
        (
            "mpe2/simple_spread",
            {},
            "unknown environment id 'mpe2/simple_spread'; the nearest names are mpe2/simple_spr",
        ),
    ],
)
def test_mistakes_are_one_line(make: Any, settings: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message):
        envs.make(make, num_envs=2, **settings)
