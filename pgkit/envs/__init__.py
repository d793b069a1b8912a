"""Environments: Gymnasium, dm_control and TorchRL behind one function, as simulators with TorchRL's specs."""

import gymnasium as gym

from pgkit.envs.gym_list import Gymnasium
from pgkit.envs.gym_vector import GymnasiumVector
from pgkit.envs.ids import make_one
from pgkit.envs.make import make, vector_of
from pgkit.envs.prompts import Prompts, prompts
from pgkit.envs.tokenizers import Characters
from pgkit.envs.torch_batch import Torch
from pgkit.envs.vector import VectorEnv
from pgkit.envs.vmas_batch import Vmas

gym.register("pgkit/TMaze-v0", entry_point="pgkit.envs.tmaze:TMaze", max_episode_steps=40)

__all__ = [
    "Characters",
    "Gymnasium",
    "GymnasiumVector",
    "Prompts",
    "Torch",
    "VectorEnv",
    "Vmas",
    "make",
    "make_one",
    "prompts",
    "vector_of",
]
