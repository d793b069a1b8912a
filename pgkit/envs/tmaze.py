"""A task that only a memory solves."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class TMaze(gym.Env):
    """The T-maze (Bakker, 2002): a cue at the start of a corridor says which way to turn at its end.

    Observation: the cue (-1 or 1 at the first cell, 0 elsewhere), and 1 at the junction. Actions: left, forward, right.
    Turning at the junction ends the episode, with reward 1 where the cue pointed, else -1; any other move that does
    not go on costs 0.1. The best return is 1. A policy without memory turns the same way, with the same
    probability, whatever the cue was, so its expected return is at most 0.

    Args:
        length: cells between the start and the junction.
    """

    def __init__(self, length: int = 8) -> None:
        self.length = length
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.cue = 0, int(self.np_random.choice([-1, 1]))
        return self._observe(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        turn = int(action) - 1
        if turn and self.position == self.length:
            return self._observe(), 1.0 if turn == self.cue else -1.0, True, False, {}
        if turn or self.position == self.length:
            return self._observe(), -0.1, False, False, {}
        self.position += 1
        return self._observe(), 0.0, False, False, {}

    def _observe(self) -> np.ndarray:
        return np.array([self.cue if self.position == 0 else 0, self.position == self.length], np.float32)
