"""Replay: uniform, prioritized, n-step, on TorchRL's storages."""

from pgkit.data.prioritized import Prioritized
from pgkit.data.replay import ReplayBuffer

__all__ = ["Prioritized", "ReplayBuffer"]
