"""Environments: Gymnasium and dm_control behind one id scheme, vectorized, with TorchRL's specs."""

import gymnasium as gym

from pgkit.envs.arrays import ArrayEnv
from pgkit.envs.make import make, make_one
from pgkit.envs.prompts import Prompts, prompts
from pgkit.envs.tokenizers import Characters
from pgkit.envs.vector import VectorEnv

gym.register("pgkit/TMaze-v0", entry_point="pgkit.envs.tmaze:TMaze", max_episode_steps=40)

__all__ = ["ArrayEnv", "Characters", "Prompts", "VectorEnv", "make", "make_one", "prompts"]
