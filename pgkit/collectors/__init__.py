"""Collectors: iterables of rollouts."""

from pgkit.collectors.torchrl import TorchRLCollector
from pgkit.collectors.vector import VectorCollector

__all__ = ["TorchRLCollector", "VectorCollector"]
