"""Environments: Gymnasium and dm_control behind one id scheme, vectorized, with TorchRL's specs."""

from pgkit.envs.arrays import ArrayEnv
from pgkit.envs.make import make, make_one
from pgkit.envs.vector import VectorEnv

__all__ = ["ArrayEnv", "VectorEnv", "make", "make_one"]
