"""Environments of images, small and fast: a bar that an action moves; further right is better."""

import gymnasium as gym
import numpy as np


class Bar(gym.Env):
    """Twelve steps; the first observation depends on the seed. Gray images ``[1, size, size]``."""

    def __init__(self, size=20, discrete=False, render_mode=None, scale=1.0):
        self.size, self.discrete, self.render_mode, self.scale = size, discrete, render_mode, scale
        self.observation_space = gym.spaces.Box(0, 255, (1, size, size), np.uint8)
        self.action_space = gym.spaces.Discrete(3) if discrete else gym.spaces.Box(-1, 1, (1,), np.float32)

    def _draw(self):
        image, at = np.zeros((1, self.size, self.size), np.uint8), int(self.at)
        image[0, :, at : at + 4] = 255
        image[0, 0, :] = self.steps
        return image

    def render(self):
        return np.repeat(self._draw(), 3, 0).transpose(1, 2, 0)[:, ::-1]  # channels last, a negative stride

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.steps = float(self.np_random.integers(0, self.size - 4)), 0
        return self._draw(), {}

    def step(self, action):
        move = int(action) - 1 if self.discrete else float(action[0])
        self.at = min(max(self.at + 2 * move, 0), self.size - 4)
        self.steps += 1
        return self._draw(), self.scale * self.at / self.size, False, self.steps >= 12, {}


gym.register("Bar-v0", entry_point=Bar)
gym.register("DiscreteBar-v0", entry_point=Bar, kwargs={"discrete": True, "size": 36})
