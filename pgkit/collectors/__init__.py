"""Collectors: iterables of rollouts."""

from pgkit.collectors.asynchronous import AsyncCollector
from pgkit.collectors.cluster import connect
from pgkit.collectors.ray import RayCollector
from pgkit.collectors.ray_explorers import RayExplorers
from pgkit.collectors.tokens import TokenCollector
from pgkit.collectors.torchrl import TorchRLCollector
from pgkit.collectors.vector import VectorCollector

__all__ = [
    "AsyncCollector",
    "RayCollector",
    "RayExplorers",
    "TokenCollector",
    "TorchRLCollector",
    "VectorCollector",
    "connect",
]
