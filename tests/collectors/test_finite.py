"""Numbers that no update can use end a run before it trains on them; outliers set no scale for good."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from pgkit import advantages, collectors, envs, losses, modules, updates
from pgkit.errors import UserError


class Once(gym.Env):
    """A random walk; in step ``at`` of the ``which``-th environment, ``wrong`` says what comes."""

    observation_space, action_space = gym.spaces.Box(-9, 9, (3,), np.float64), gym.spaces.Box(-1, 1, (1,))
    made = 0

    def __init__(self, wrong: dict[str, Any], which: int = 1, at: int = 100) -> None:
        self.wrong = wrong if Once.made == which else {}
        Once.made += 1
        self.at, self.steps = at, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self.np_random.uniform(-1, 1, 3), {}

    def step(self, action: Any) -> Any:
        self.t, self.steps = self.t + 1, self.steps + 1
        wrong = self.wrong if self.steps == self.at else {}
        obs = self.np_random.uniform(-1, 1, 3)
        obs[1] = wrong.get("obs", obs[1])
        return obs, wrong.get("reward", float(obs[0])), self.t == 20, False, {}


def training(wrong: dict[str, Any], rollouts: int = 6) -> Any:
    """Weights, normalizer and scale after some rollouts of PPO."""
    torch.manual_seed(0)
    Once.made = 0
    env = envs.make(partial(Once, wrong), num_envs=2)
    normalizer, scale = modules.ObsNormalizer(env), modules.ReturnScale()
    actor = modules.gaussian_actor(env, (4,), normalizer=normalizer)
    critic = modules.state_value(env, (4,), normalizer=normalizer)
    weights = [*actor.parameters(), *critic.parameters()]
    advantage = advantages.GAE(critic, gamma=0.9, return_scale=scale)
    adam = torch.optim.Adam(weights, 1e-3)
    update = updates.OnPolicyUpdate(losses.ClipPPOLoss(actor, critic), advantage, adam, epochs=2, compile="off")
    collector = collectors.VectorCollector(env, actor, frames_per_batch=64, compile="off")
    try:
        for _ in range(rollouts):
            rollout = collector.rollout()
            update(rollout)
            normalizer.update(rollout["observation"])
            scale.update(rollout["value_target"])
    finally:
        assert all(x.isfinite().all() for x in [*weights, *normalizer.buffers(), *scale.buffers()])
    return normalizer, scale


@pytest.mark.fault(
    kind=2,
    injected="one observation or reward that is NaN, infinite, 1e300 or ±1e38, after the first updates",
    outcome="the run ends before the update, naming environment, step and entry; weights and moments are finite",
)
@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e38, -1e38, 1e300, 1e20])
@pytest.mark.parametrize("entry", ["obs", "reward"])
def test_one_number_that_no_update_can_use(entry: str, value: float):
    name = "next.observation" if entry == "obs" else "next.reward"
    line = rf"'{name}' of environment 1 is -?(nan|inf|1e\+\d\d) at step 3 of the rollout"
    if entry == "reward" and value != value:
        line = "Once.step returned a reward nan|" + line
    with pytest.raises(UserError, match=line):
        training({entry: value})


@pytest.mark.fault(
    kind=3,
    injected="one reward of 1e6, 1e9 or 1e17 in 768 steps, in the first rollout or later",
    outcome="the scale of returns grows to what 1,000 deviations explain, and training goes on; it comes back",
)
@pytest.mark.parametrize("reward", [1e6, 1e9, 1e17])
def test_one_reward_does_not_set_the_scale_of_returns(reward: float):
    clean = training({}).__getitem__(1).scale
    assert training({"reward": reward})[1].scale < 300 * clean
    torch.manual_seed(0)
    for outlier_at in (0, 30):
        scale = modules.ReturnScale()
        for i in range(200):
            x = torch.randn(256)
            x[7] = reward if i == outlier_at else x[7]
            scale.update(x / scale.scale)
        assert 0.9 < scale.scale < 8


def test_rare_rewards_are_no_outliers():
    # nothing but noise of 1e-3 for 10 rollouts, then one return in a hundred is 1: the scale of all is 0.1 within 3
    torch.manual_seed(0)
    scale = modules.ReturnScale()
    for i in range(13):
        x = 1e-3 * torch.randn(2048)
        x[::100] += i >= 10
        scale.update(x / scale.scale)
    assert scale.scale > 0.04
    usual, exact, seen = modules.ReturnScale(), modules.ReturnScale(clip=float("inf")), []
    for i in range(5):
        seen.append(torch.randn(500) * (1 + i) * 10)
        usual.update(seen[-1] / usual.scale)
        exact.update(seen[-1] / exact.scale)
    assert usual.scale == exact.scale
    torch.testing.assert_close(usual.scale, torch.cat(seen).std(correction=0), rtol=1e-4, atol=0)
