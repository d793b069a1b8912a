"""An environment that fails in a way, at a step, that is asked for."""

import os
import signal
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np


def leave() -> None:
    os._exit(0)


DEEDS = {
    "raise": lambda: [][1],
    "sys.exit": lambda: sys.exit(0),
    "os._exit": leave,
    "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "stop": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "sleep": lambda: time.sleep(1000),
}


class Faulty(gym.Env):
    """Episodes of 5 steps; observes its step and a number drawn at the reset, and does a deed at a step of an episode.

    ``flag`` is a file: the deed is done only once, where the file is not there yet. None: whenever that step comes.
    """

    observation_space = gym.spaces.Box(-100, 100, (2,))
    action_space = gym.spaces.Box(-1, 1, (1,))
    resets = 0

    def __init__(
        self, deed: str = "", step: int = 0, episode: int = 2, flag: str | Path | None = None, length: int = 5
    ):
        self.deed, self.at, self.length = deed, (episode, step), length
        self.flag = None if flag is None else Path(flag)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets, self.steps, self.drawn = self.resets + 1, 0, self.np_random.uniform()
        self._do()
        return self._observed(), {}

    def step(self, action):
        self.steps += 1
        self._do()
        return self._observed(), float(action[0]), self.steps == self.length, False, {}

    def _do(self) -> None:
        if self.deed and self.at == (self.resets, self.steps) and not (self.flag and self.flag.exists()):
            if self.flag:
                self.flag.touch()
            DEEDS[self.deed]()

    def _observed(self):
        return np.array([self.steps, self.drawn], np.float32)


gym.register("Faulty-v0", Faulty)
