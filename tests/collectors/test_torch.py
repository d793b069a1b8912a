"""Batched torch environments on the fast collector: a pendulum of one's own, transforms, and what a resume brings."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, RewardScaling, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from pgkit import advantages, collectors, envs, losses, modules, run, updates
from tests.collectors.test_vector import equal


class Pendulum(EnvBase):
    """The classic one, for ``num_envs`` at once; its state is in buffers, so that it resumes exactly."""

    state: torch.Tensor
    resets: torch.Tensor
    resume = "exact"

    def __init__(self, num_envs: int, seed: int = 0) -> None:
        super().__init__(batch_size=(num_envs,))
        self.observation_spec = Composite(observation=Unbounded((num_envs, 3)), shape=(num_envs,))
        self.action_spec, self.reward_spec = Bounded(-2, 2, (num_envs, 1)), Unbounded((num_envs, 1))
        self.register_buffer("state", torch.zeros(num_envs, 2))
        self.register_buffer("resets", torch.zeros((), dtype=torch.int64))

    def observe(self) -> torch.Tensor:
        theta, speed = self.state.unbind(-1)
        return torch.stack([theta.cos(), theta.sin(), speed], -1)

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        generator = torch.Generator().manual_seed(1000 * self.seed + int(self.resets))
        fresh = torch.rand(self.state.shape, generator=generator) * torch.tensor([6.28, 2.0]) - 1.0
        self.resets = self.resets + 1
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        self.state = fresh if chosen is None else torch.where(chosen, fresh, self.state)
        return TensorDict({"observation": self.observe()}, self.batch_size)

    def _step(self, tensordict: Any) -> TensorDict:
        theta, speed = self.state.unbind(-1)
        push = tensordict["action"].squeeze(-1)
        angle = (theta + torch.pi) % (2 * torch.pi) - torch.pi
        reward = -(angle**2 + 0.1 * speed**2 + 0.001 * push**2)
        speed = (speed + 0.05 * (15 * theta.sin() + 3 * push)).clamp(-8, 8)
        self.state = torch.stack([theta + 0.05 * speed, speed], -1)
        flag = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        after = {"observation": self.observe(), "reward": reward.unsqueeze(-1), "done": flag}
        return TensorDict(after, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.seed, self.resets = seed or 0, torch.zeros_like(self.resets)


def transformed(num_envs: int, seed: int = 0) -> EnvBase:
    return TransformedEnv(Pendulum(num_envs), Compose(StepCounter(20), RewardScaling(0.0, 0.1)))


def agent(make: Callable[..., Any] = Pendulum, num_envs: int = 1024, steps: int = 8, **settings: Any) -> Any:
    torch.manual_seed(0)
    env = envs.make(make, num_envs=num_envs, seed=1)
    actor, critic = modules.gaussian_actor(env, (16,)), modules.state_value(env, (16,))
    loss = losses.ClipPPOLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    settings = {"epochs": 2, "minibatch_size": num_envs * steps // 2, "compile": "off"} | settings
    update = updates.OnPolicyUpdate(loss, advantages.GAE(critic), optimizer, **settings)
    collector = collectors.VectorCollector(env, actor, frames_per_batch=num_envs * steps, compile="off")
    return actor, update, collector


def test_a_batched_pendulum_of_ones_own_collects_and_trains(monkeypatch):
    actor, update, collector = agent()
    share = collector._alone()
    with monkeypatch.context() as patch:  # no NumPy on the way
        for name in ("numpy", "__array__", "tolist"):
            patch.setattr(torch.Tensor, name, lambda *args: pytest.fail("a tensor became an array"))
        rollout = collector.rollout()
    assert share is collector._share and rollout.batch_size == (1024, 8)
    # the environment's own arithmetic, step by step, from the same first observation and the same actions
    env = collector.env.simulator.env
    twin = Pendulum(1024)
    twin.set_seed(1)
    assert torch.equal(twin.reset()["observation"], rollout["observation"][:, 0])
    for t in range(8):
        after = twin.step(TensorDict({"action": rollout["action"][:, t].clamp(-2, 2)}, (1024,)))["next"]
        assert torch.equal(after["observation"], rollout["next", "observation"][:, t])
        assert torch.equal(after["reward"], rollout["next", "reward"][:, t])
    assert torch.equal(twin.state, env.state)
    again = actor.get_dist(rollout.select("observation")).log_prob(rollout["action"])
    torch.testing.assert_close(rollout["action_log_prob"], again, rtol=1e-4, atol=1e-5)
    before = [p.clone() for p in actor.parameters()]
    assert all(np.isfinite(x) for x in update(rollout).values())
    assert any(not torch.equal(a, b) for a, b in zip(before, actor.parameters(), strict=True))


def test_a_transformed_environment_ends_its_episodes_and_counts_scaled_rewards():
    _, _, collector = agent(transformed, 4, 50)
    rollout = collector.rollout()
    ends = rollout["next", "truncated"][..., 0].nonzero()
    assert ends[:, 1].tolist() == [19, 39] * 4 and not rollout["next", "terminated"].any()
    returns = rollout["next", "reward"][:, :20].sum(1)
    torch.testing.assert_close(rollout["next", "episode_reward"][:, 19], returns)
    assert returns.min() > -34 and returns.max() < 0 and (rollout["next", "step_count"][:, 39] == 20).all()
    assert not torch.equal(rollout["next", "observation"][:, 19], rollout["observation"][:, 20])


class Inexact(Pendulum):
    resume = "new episodes"


@pytest.mark.parametrize(("make", "exact"), [(Pendulum, True), (transformed, True), (Inexact, False)])
def test_a_resume_is_exact_or_begins_new_episodes_and_says_which(make, exact, caplog):
    _, _, collector = agent(make, 4, 30)
    collector.rollout()
    state = collector.state_dict()
    expected = collector.rollout()
    _, _, other = agent(make, 4, 30)
    with caplog.at_level("INFO", "pgkit"):
        other.load_state_dict(state)
    found = other.rollout()
    assert other.frames == 240 and equal(found, expected) == exact
    assert ("every environment goes on where it was" if exact else "every environment begins anew") in caplog.text
    if not exact:
        assert (found["next", "step_count"][:, 0] == 1).all()
        _, _, first = agent(make, 4, 30)
        assert not torch.equal(found["observation"][:, 0], first.rollout()["observation"][:, 0])


@pytest.mark.parametrize("make", [transformed, Inexact])
def test_a_run_trains_evaluates_and_resumes(make, tmp_path, capsys, caplog):
    def train(**flags: Any) -> None:
        args = PendulumArgs(env_id="pendulum", run_dir=tmp_path / "r", eval_episodes=4, **flags)
        with run.Run(args, "torch") as log:
            actor, update, collector = agent(time_limited if make is Inexact else make, 4, 25)
            collector.total_frames = args.total_frames
            log.track(policy=actor, eval_env=evaluation, update=update, collector=collector)
            for rollout in collector:
                log.step(collector.frames, rollout, update(rollout))

    def time_limited(num_envs: int, seed: int = 0) -> EnvBase:
        return TransformedEnv(make(num_envs), StepCounter(20))

    train(total_frames=200)
    with caplog.at_level("INFO", "pgkit"):
        train(total_frames=400, resume=tmp_path / "r")
    assert ("goes on where it was" if make is transformed else "begins anew") in caplog.text
    assert "eval/mean_reward" in (tmp_path / "r" / "metrics.csv").read_text()
    policy = run.load_policy(tmp_path / "r", "latest", agent=pendulum_agent)
    assert policy.frames == 400 and policy.predict(np.zeros(3)).shape == (1,)
    assert abs(policy.predict(np.full(3, 1e6))) <= 2


def evaluation(num_envs: int, seed: int, workers: int = 1) -> envs.VectorEnv:
    return envs.make(transformed, num_envs, seed=seed)


class PendulumArgs(run.RunArgs):
    """Settings of a run on an environment that has no id."""

    def make_env(self, num_envs: int, seed: int, workers: int = 1) -> envs.VectorEnv:
        return evaluation(num_envs, seed)


def pendulum_agent(args: PendulumArgs, env: envs.VectorEnv) -> run.Agent:
    return run.Agent(agent(transformed, 4, 25)[0])


class Team(EnvBase):
    """Two agents under the name ``agents``, with a reward each and one end for both, after 5 steps."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(batch_size=(num_envs,))
        n, flag = num_envs, Categorical(2, (num_envs, 1), dtype=torch.bool)
        group = Composite(observation=Unbounded((n, 2, 3)), shape=(n, 2))
        self.observation_spec = Composite(agents=group, shape=(n,))
        self.action_spec = Composite(agents=Composite(action=Bounded(-1, 1, (n, 2, 1)), shape=(n, 2)), shape=(n,))
        self.reward_spec = Composite(agents=Composite(reward=Unbounded((n, 2, 1)), shape=(n, 2)), shape=(n,))
        self.done_spec = Composite(done=flag, terminated=flag, shape=(n,))

    def _observe(self) -> TensorDict:
        agents = torch.arange(2.0).view(1, 2, 1).expand(*self.batch_size, 2, 3) + self.t.view(-1, 1, 1)
        return TensorDict({"agents": TensorDict({"observation": agents}, (*self.batch_size, 2))}, self.batch_size)

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        self.t = torch.zeros(self.batch_size)
        return self._observe()

    def _step(self, tensordict: Any) -> TensorDict:
        self.t = self.t + 1
        out, done = self._observe(), (self.t == 5).unsqueeze(-1)
        out["agents", "reward"] = tensordict["agents", "action"] + torch.tensor([[10.0], [20.0]])
        return out.set("done", done).set("terminated", done.clone())

    def _set_seed(self, seed: int | None) -> None: ...


def test_a_group_of_agents_lies_under_its_name():
    net = TensorDictModule(nn.Linear(3, 1), [("agents", "observation")], [("agents", "action")])
    env = envs.make(Team, num_envs=3, seed=1)
    check_env_specs(env)
    collector = collectors.VectorCollector(env, net, frames_per_batch=21, init_random_frames=1, compile="off")
    drawn, rollout = collector.rollout(), collector.rollout()
    assert rollout["agents"].batch_size == rollout["next", "agents"].batch_size == (3, 7, 2)
    assert rollout["next", "done"].shape == (3, 7, 1) and rollout["next", "step_count"].shape == (3, 7, 1)
    for made in (drawn, rollout):
        expected = made["agents", "action"].clamp(-1, 1) + torch.tensor([[10.0], [20.0]])
        torch.testing.assert_close(made["next", "agents", "reward"], expected)
    torch.testing.assert_close(rollout["agents", "action"], net(rollout.clone())["agents", "action"])
    totals = torch.cat([drawn, rollout], 1)["next", "agents", "reward"][:, :5].sum(1)
    torch.testing.assert_close(drawn["next", "agents", "episode_reward"][:, 4], totals)
    assert torch.cat([drawn, rollout], 1)["next", "done"][0, :, 0].nonzero().flatten().tolist() == [4, 9]
    returns, lengths = run.play(net, envs.make(Team, num_envs=3), episodes=3)
    assert lengths.tolist() == [5, 5, 5]
    obs = torch.arange(2.0).view(1, 2, 1) + torch.arange(5.0).view(5, 1, 1).expand(5, 2, 3)
    expected = (net.module(obs).clamp(-1, 1) + torch.tensor([[10.0], [20.0]])).sum(0).mean().item()
    np.testing.assert_allclose(returns, [expected] * 3, rtol=1e-5)
