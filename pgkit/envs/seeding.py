"""Seeds of episodes."""

from __future__ import annotations

import numpy as np


def episode_seed(seed: int, index: int, episode: int) -> int:
    """Seed of one episode, a function of the run's seed, the environment's index and the episode's number.

    It has 31 bits, so that an environment may keep it in a signed integer.
    """
    return int(np.random.SeedSequence((seed, index, episode)).generate_state(1)[0] >> 1)
