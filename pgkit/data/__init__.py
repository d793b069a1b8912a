"""Replay: uniform, prioritized, n-step, on TorchRL's storages."""

from pgkit.data.files import BesideCheckpoint, in_files
from pgkit.data.prioritized import Prioritized
from pgkit.data.ray_replay import RayReplay
from pgkit.data.recent import Recent
from pgkit.data.replay import ReplayBuffer

__all__ = [
    "BesideCheckpoint",
    "Prioritized",
    "RayReplay",
    "Recent",
    "ReplayBuffer",
    "in_files",
]
