"""Schedules: a value as a function of the training's progress."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, pi

Schedule = Callable[[float], float]


def linear(start: float, end: float = 0.0) -> Schedule:
    """From ``start`` at progress 0 to ``end`` at progress 1, in a straight line."""
    return lambda progress: start + (end - start) * min(max(progress, 0.0), 1.0)


def cosine(start: float, end: float = 0.0) -> Schedule:
    """From ``start`` to ``end`` in half a cosine wave: slowly at both ends."""
    return lambda progress: end + (start - end) * (1 + cos(pi * min(max(progress, 0.0), 1.0))) / 2


def constant(value: float) -> Schedule:
    """``value`` throughout."""
    return lambda progress: value
