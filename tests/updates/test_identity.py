"""Learning shown in seconds: the action must repeat the observation."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from pgkit import advantages, collectors, envs, losses, modules, run, updates


class Identity(gym.Env):
    """Reward is highest where the action equals the observation; 16 independent steps an episode."""

    def __init__(self, discrete):
        self.discrete = discrete
        self.observation_space = spaces.Discrete(3) if discrete else spaces.Box(-1, 1, (2,))
        self.action_space = spaces.Discrete(3) if discrete else spaces.Box(-1, 1, (2,))

    def _draw(self):
        draw = self.np_random
        self.state = int(draw.integers(3)) if self.discrete else draw.uniform(-1, 1, 2).astype(np.float32)
        return self.state

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._draw(), {}

    def step(self, action):
        self.t += 1
        reward = float(action == self.state) if self.discrete else -float(np.abs(action - self.state).sum())
        return self._draw(), reward, False, self.t == 16, {}


@pytest.mark.parametrize(
    ("discrete", "build", "threshold"),
    [
        (True, modules.categorical_actor, 15.9),
        (False, modules.gaussian_actor, -1.5),
        (
            False,
            lambda env, hidden: modules.tanh_normal_actor(env, hidden, tanh_loc=True, log_std_bounds=(-3, -1)),
            -1.5,
        ),
    ],
)
def test_learns_the_identity(discrete, build, threshold):
    torch.manual_seed(0)
    env = envs.make(lambda: Identity(discrete), num_envs=8, seed=1)
    actor, critic = build(env, hidden=(32,)), modules.state_value(env, hidden=(32,))
    update = updates.OnPolicyUpdate(
        loss=losses.ClipPPOLoss(actor, critic),
        advantage=advantages.GAE(critic, gamma=0.5, lmbda=0.9),
        optimizer=torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=3e-3),
        compile="off",
    )
    before = run.evaluate(actor, env, 10)["eval/mean_reward"]
    for rollout in collectors.VectorCollector(env, actor, frames_per_batch=256, total_frames=12_800):
        update(rollout)
    after = run.evaluate(actor, env, 10)["eval/mean_reward"]
    assert before < threshold - 1 and after > threshold
