"""Bounds that cannot be squashed into are refused; modules with a mode act, estimate and learn in one that is said."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn
from torchrl.modules import NoisyLinear

from pgkit import advantages, collectors, envs, losses, modules, updates
from pgkit.errors import UserError


class Bounded(gym.Env):
    observation_space = spaces.Box(-1, 1, (3,), np.float32)

    def __init__(self, low: Any, high: Any, dtype: Any = np.float32) -> None:
        self.action_space = spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self.np_random.uniform(-1, 1, 3).astype(np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return self.np_random.uniform(-1, 1, 3).astype(np.float32), float(self.t), self.t == 9, False, {}


MOST = np.finfo(np.float32).max


@pytest.mark.fault(
    kind=9,
    injected="actions bounded to ±finfo.max, ±1e10, ±1e308, on one side only, or to low == high",
    outcome="squashing actors refuse them where they are built, in words about the bounds; Gaussians take them",
)
@pytest.mark.parametrize(
    ("low", "high", "dtype", "message"),
    [
        ([-MOST] * 2, [MOST] * 2, np.float32, r"action 0 is bounded to \[-3.40282e\+38, 3.40282e\+38\], too wide"),
        ([-1, -1e10], [1, 1e10], np.float32, r"action 1 is bounded to \[-1e\+10, 1e\+10\], too wide to squash"),
        ([-1e8, -1], [1, 1], np.float32, "action 0 is bounded to .*too wide to squash"),
        ([0, -1], [0, 1], np.float32, r"action 0 is bounded to \[0, 0\], which leaves no choice: take it out"),
        ([-1e308] * 2, [1e308] * 2, np.float64, "has no bounds to squash into"),
        ([0, 0], [np.inf, np.inf], np.float32, "has no bounds to squash into: use modules.gaussian_actor"),
        ([-(2**63)] * 2, [2**63 - 1] * 2, np.int64, "too wide to squash"),
    ],
)
def test_bounds_that_cannot_be_squashed_into(low: Any, high: Any, dtype: Any, message: str):
    env = envs.make(lambda: Bounded(low, high, dtype), num_envs=2)
    for build in (modules.tanh_normal_actor, modules.deterministic_actor):
        with pytest.raises(UserError, match=message):
            build(env, (4,))
    actor = modules.gaussian_actor(env, (4,))
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=20, compile="off").rollout()
    assert rollout["action"].isfinite().all() and rollout["action_log_prob"].isfinite().all()


def test_usual_bounds_are_squashed_into():
    env = envs.make(lambda: Bounded([-1e5, 0], [1e5, 1e-6]), num_envs=2)
    rollout = collectors.VectorCollector(
        env, modules.tanh_normal_actor(env, (4,)), frames_per_batch=20, compile="off"
    ).rollout()
    assert rollout["action"].isfinite().all() and rollout["action_log_prob"].isfinite().all()
    with pytest.raises(UserError, match=r"the action space has shape \(0,\), which leaves nothing to decide"):
        envs.make(lambda: Bounded([], []))


class OwnDropout(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return nn.functional.dropout(x, 0.5, self.training)


LAYERS = {"BatchNorm": lambda: nn.BatchNorm1d(8), "Dropout": lambda: nn.Dropout(0.5), "own": OwnDropout}


def statistics(*networks: nn.Module) -> list[torch.Tensor]:
    return [x.clone() for network in networks for x in network.buffers()]


def same(one: list[torch.Tensor], other: list[torch.Tensor]) -> bool:
    return all(map(torch.equal, one, other))


@pytest.mark.fault(
    kind=11,
    injected="BatchNorm, Dropout and a module of the user's own with a mode in actor and critic; one environment",
    outcome="the first ratio is 1; building, collecting and estimating move no statistic; modes stay as they were",
)
@pytest.mark.parametrize("num_envs", [1, 4])
@pytest.mark.parametrize("layer", LAYERS)
def test_modules_with_a_mode(layer: str, num_envs: int):
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=num_envs)
    bodies = [nn.Sequential(nn.Linear(3, 8), LAYERS[layer](), nn.Tanh()) for _ in range(2)]
    actor, critic = modules.gaussian_actor(env, encoder=bodies[0]), modules.state_value(env, encoder=bodies[1])
    fresh = statistics(*bodies)
    collector = collectors.VectorCollector(env, actor, frames_per_batch=64 * num_envs, compile="off")
    rollout = advantages.GAE(critic)(collector.rollout())
    assert same(fresh, statistics(*bodies)) and all(x.training for body in bodies for x in body)
    expected = critic.eval()(rollout.reshape(-1).select("observation"))["state_value"].detach()
    torch.testing.assert_close(rollout["state_value"].reshape(-1, 1), expected)
    critic.train()
    loss = losses.ClipPPOLoss(actor, critic)
    out = loss(rollout.reshape(-1))
    assert abs(float(out["approx_kl"])) < 1e-10 and float(out["clip_fraction"]) == 0
    adam = torch.optim.Adam([*actor.parameters(), *critic.parameters()], 0.0)
    update = updates.OnPolicyUpdate(loss, advantages.GAE(critic), adam, epochs=1, compile="off")
    before = statistics(bodies[0])
    assert abs(update(rollout)["approx_kl"]) < 1e-10 and same(before, statistics(bodies[0]))
    assert all(x.training for body in bodies for x in body)


@pytest.mark.fault(
    kind=11,
    injected="`actor.eval()` and `actor.train()` between rollouts, and other numbers of workers",
    outcome="collecting is not recorded anew, and the numbers are the same",
)
def test_the_mode_is_fixed_in_the_record(caplog: pytest.LogCaptureFixture):
    rollouts = []
    for workers, toggles in ((1, False), (1, True), (2, False)):
        torch.manual_seed(0)
        env = envs.make("Pendulum-v1", num_envs=4, workers=workers)
        actor = modules.gaussian_actor(env, encoder=nn.Sequential(nn.Linear(3, 8), nn.Dropout(0.5), nn.BatchNorm1d(8)))
        collector = collectors.VectorCollector(env, actor, frames_per_batch=40, compile="off")
        collector.rollout()
        share = collector._share
        if toggles:
            actor.eval()
        rollouts.append(collector.rollout())
        assert collector._share is share
        collector.shutdown()
    assert "start again" not in caplog.text
    for other in rollouts[1:]:
        assert (other == rollouts[0]).all()


def test_layers_of_noise_explore_while_collecting_in_any_mode():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=2)
    body = nn.Sequential(nn.Linear(3, 8), NoisyLinear(8, 8, use_exploration_type=False))
    actor = modules.gaussian_actor(env, encoder=body, log_std=-20.0).eval()
    collector = collectors.VectorCollector(env, actor, frames_per_batch=2, compile="off")
    rollout = collector.rollout()
    quiet = actor.get_dist(rollout.select("observation")).mean
    body[1].train()
    noisy = actor.get_dist(rollout.select("observation")).mean
    assert (noisy - quiet).abs().max() > 1e-4
    torch.testing.assert_close(rollout["action"], noisy.detach(), atol=1e-5, rtol=0)
