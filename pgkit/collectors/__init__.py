"""Collectors: iterables of rollouts."""

from pgkit.collectors.vector import VectorCollector

__all__ = ["VectorCollector"]
