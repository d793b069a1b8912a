"""How many threads a run's products get: measured when it starts, so that neighbours on the machine count."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from logging import getLogger
from statistics import median

import torch

_WIDTH, _CALLS, _ROUNDS = 256, 10, 5
_GAIN = 1.4  # two threads must be so much faster: a step is not products alone, and the second core has other uses


def fastest_threads(measure: Callable[[int], float] | None = None) -> int:
    """2 threads where products 256 wide are much faster with them here and now, else 1.

    Args:
        measure: seconds that a product takes with so many threads; None: torch's.
    """
    if _cores() < 2:
        return 1
    before = torch.get_num_threads()
    try:
        times = [[(measure or _seconds)(threads) for threads in (1, 2)] for _ in range(_ROUNDS)]
    finally:
        torch.set_num_threads(before)
    gain = median(one / two for one, two in times)
    chosen = 2 if gain >= _GAIN else 1
    getLogger("pgkit").info(
        "--threads %d: a product %d wide is %.1f times as fast with two threads now", chosen, _WIDTH, gain
    )
    return chosen


def _seconds(threads: int) -> float:
    """Seconds for one product, after one that wakes the threads."""
    torch.set_num_threads(threads)
    x = torch.ones(_WIDTH, _WIDTH)
    torch.mm(x, x)
    start = time.perf_counter()
    for _ in range(_CALLS):
        torch.mm(x, x)
    return (time.perf_counter() - start) / _CALLS


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if "sched_getaffinity" in vars(os) else os.cpu_count() or 1
