"""Simulators as recorded graphs: VMAS's scenarios and environments of one's own step as they do without."""

from typing import Any, cast

import pytest
import torch
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, StepCounter, TransformedEnv
from vmas.simulator.core import Agent, World
from vmas.simulator.scenario import BaseScenario

from pgkit import envs
from pgkit.envs.torch_batch import Torch
from pgkit.envs.vmas_batch import Vmas
from pgkit.errors import UserError
from tests.collectors.test_torch import Pendulum
from tests.envs.test_agents import same, steps


class Hits(BaseScenario):
    """Agents that cross the line x = 0.5 lose speed and score; ``kind`` is what a record cannot hold."""

    kind = ""

    def make_world(self, batch_dim: int, device: Any, **kwargs: Any) -> World:
        world = World(batch_dim, device)
        for i in range(2):
            world.add_agent(Agent(f"agent_{i}"))
        self.hits, self.calls = torch.zeros(batch_dim), 0
        return world

    def reset_world_at(self, env_index: int | None = None) -> None:
        for agent in self.world.agents:
            place = torch.rand(self.world.batch_dim, 2) if env_index is None else torch.rand(2)
            agent.set_pos(place, batch_index=env_index)
        self.hits[slice(None) if env_index is None else env_index] = 0

    def reward(self, agent: Agent) -> Tensor:
        place, speed = cast(Any, agent.state.pos), cast(Any, agent.state.vel)
        over = place[:, 0] > 0.5
        assert not place.isnan().any()
        if over.any():
            self.hits[over] += 1
            speed[over] *= 0.5
        self.calls += self.kind == "counts"
        if self.kind == "forgets" and agent is self.world.agents[0]:  # a tensor in every other step, else a number
            self.last = 0 if isinstance(vars(self).get("last"), Tensor) else self.hits.sum()
        return self.hits + (float(self.hits.sum()) if self.kind == "reads" else 0.0)

    def observation(self, agent: Agent) -> Tensor:
        return torch.cat([agent.state.pos, agent.state.vel], -1)


def both(scenario: Any, num_envs: int = 16, **settings: Any) -> tuple[Vmas, Vmas]:
    eager = Vmas(scenario() if isinstance(scenario, type) else scenario, num_envs, 1, None, 7, **settings)
    return eager, Vmas(
        scenario() if isinstance(scenario, type) else scenario, num_envs, 1, None, 7, compile="record", **settings
    )


def compare(eager: Any, recorded: Any, count: int = 20) -> None:
    draw = torch.Generator().manual_seed(0)
    for _ in range(count):
        spec = eager.action_spec["agents", "action"]
        drawn = torch.rand(spec.shape, generator=draw)
        action = {("agents", "action"): 2 * drawn - 1 if spec.dtype.is_floating_point else (spec.n * drawn).long()}
        a, b = eager.step(action), recorded.step(action)
        for one, other in ((a.next, b.next), (a.reward, b.reward), (a.terminated, b.terminated), (a.fresh, b.fresh)):
            for key, x in one.items():
                torch.testing.assert_close(other[key], x, rtol=0, atol=3e-5)


@pytest.mark.parametrize(
    ("scenario", "settings", "names"),
    [
        ("balance", {"n_agents": 4}, ["advance", "renew"]),
        ("simple_spread", {"continuous_actions": False}, ["advance", "renew"]),
        ("navigation", {}, ["advance"]),  # it draws places until no two are near each other
        (Hits, {}, ["advance", "renew"]),
    ],
)
def test_a_recorded_scenario_steps_as_it_does_without(scenario: Any, settings: Any, names: list[str]):
    state = torch.get_rng_state()
    eager, recorded = both(scenario, **settings)
    assert torch.equal(torch.get_rng_state(), state)
    assert list(recorded.recorded_parts) == names
    compare(eager, recorded)


def test_a_recorded_simulator_resumes_exactly():
    one, other = (Vmas("balance", 5, seed, None, 6, compile="record") for seed in (1, 3))
    steps(one, 8)
    other.load_state_dict(one.state_dict())
    assert same(steps(one, 9, 4), steps(other, 9, 4))


@pytest.mark.parametrize(
    ("kind", "why"),
    [("counts", "the number 'scenario.calls'"), ("reads", "reads a number"), ("forgets", "'scenario.last'")],
)
def test_what_no_record_holds_runs_as_it_is_and_the_log_says_why(kind: str, why: str, caplog: pytest.LogCaptureFixture):
    caplog.set_level("INFO", logger="pgkit")
    scenario = type("Own", (Hits,), {"kind": kind})
    eager, recorded = both(scenario)
    assert "advance" not in recorded.recorded_parts
    assert any("is not recorded and runs as it is" in line and why in line for line in caplog.messages)
    compare(eager, recorded, 4)


class Walk(EnvBase):
    """A random walk that ends beyond 2; its state is in its entries."""

    def __init__(self, num_envs: int = 8) -> None:
        super().__init__(batch_size=(num_envs,))
        n = num_envs
        self.observation_spec = Composite(observation=Unbounded((n, 1)), shape=(n,))
        self.action_spec, self.reward_spec = Bounded(-1, 1, (n, 1)), Unbounded((n, 1))
        flag = Categorical(2, (n, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=(n,))

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> Any:
        fresh = 0.1 * torch.randn(*self.batch_size, 1)  # TorchRL keeps the rows that go on
        return self.full_observation_spec.zero().set("observation", fresh)

    def _step(self, tensordict: Any) -> Any:
        place = tensordict["observation"] + tensordict["action"] + 0.1 * torch.randn(*self.batch_size, 1)
        over = place.abs() > 2
        made = {"observation": place, "reward": -place.abs(), "done": over, "terminated": over}
        return self.full_observation_spec.zero().update(made)

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


def limited() -> EnvBase:
    return TransformedEnv(Walk(), Compose(StepCounter(5)))


@pytest.mark.parametrize(("make", "names"), [(Walk, ["advance", "renew"]), (limited, ["advance", "renew"])])
def test_an_environment_of_ones_own_steps_as_it_does_without(make: Any, names: list[str]):
    eager, recorded = Torch(make(), seed=1), Torch(make(), seed=1, compile="record")
    assert recorded.recorded_parts == names
    draw = torch.Generator().manual_seed(0)
    actions, found = torch.rand(20, 8, 1, generator=draw) * 2 - 1, []
    for simulator in (eager, recorded):
        simulator.reset(seed=3)
        made = [simulator.step({"action": x}) for x in actions]
        found.append([torch.stack([x.next["observation"], x.fresh["observation"], x.reward["reward"]]) for x in made])
    torch.testing.assert_close(*(torch.stack(x) for x in found), rtol=0, atol=3e-5)
    assert any((x[0] != x[1]).any() for x in found[0])  # episodes ended


def test_a_reset_that_cannot_be_recorded_runs_as_it_is_between_recorded_steps(caplog: pytest.LogCaptureFixture):
    caplog.set_level("INFO", logger="pgkit")
    make = lambda: TransformedEnv(Pendulum(4), Compose(StepCounter(5)))  # noqa: E731
    eager, recorded = Torch(make(), seed=1), Torch(make(), seed=1, compile="record")
    assert recorded.recorded_parts == ["advance"] and any("the resets of Pendulum" in line for line in caplog.messages)
    for simulator in (eager, recorded):
        simulator.reset(seed=3)
    for _ in range(12):
        a, b = (simulator.step({"action": torch.ones(4, 1)}) for simulator in (eager, recorded))
        torch.testing.assert_close(a.fresh["observation"], b.fresh["observation"], rtol=0, atol=3e-5)


def test_mistakes_are_one_line():
    with pytest.raises(UserError, match="compile is 'auto', 'on' or 'off', not 'yes'"):
        envs.make("vmas/balance", compile="yes")
    with pytest.raises(UserError, match="compile='on' records batched torch simulators, a .* is none"):
        envs.make("CartPole-v1", compile="on")
    with pytest.raises(UserError, match="vmas/simple_push cannot be recorded .*outside of tensors"):
        envs.make("vmas/simple_push", compile="on")
