"""Statistics of a few runs, by the definitions of Agarwal et al. (2021), https://arxiv.org/abs/2108.13264.

Scores come by task, several runs of each. Statistics have intervals from a stratified bootstrap: each task's runs are
drawn anew, with replacement, and the 2.5th and 97.5th percentiles of the statistic bound it.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import trim_mean

from pgkit.errors import UserError

Tasks = Sequence[Sequence[float] | np.ndarray]
"""Scores by task; tasks may have different numbers of runs."""


class Estimate(NamedTuple):
    """A statistic with the bounds of its 95% interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{_short(self.value)} ({_short(self.low)} to {_short(self.high)})"


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def iqm(tasks: Tasks) -> float:
    """Interquartile mean: the mean of the middle half of all runs of all tasks."""
    return float(trim_mean(np.concatenate([np.asarray(task, float) for task in tasks]), 0.25))


def interval(
    statistic: Callable[[Tasks], float], tasks: Tasks, *, samples: int = 2_000, seed: int = 0, level: float = 0.95
) -> Estimate:
    """``statistic(tasks)`` and its percentile interval by a stratified bootstrap over the runs of each task.

    Raises:
        UserError: a task has no run.
    """
    scores = [np.asarray(task, float) for task in tasks]
    if not scores or any(len(task) == 0 for task in scores):
        raise UserError("a statistic needs at least one run of every task")
    rng = np.random.default_rng(seed)
    drawn = [statistic([rng.choice(task, len(task)) for task in scores]) for _ in range(samples)]
    low, high = np.percentile(drawn, [50 * (1 - level), 50 * (1 + level)])
    return Estimate(statistic(scores), float(low), float(high))


def probability_of_improvement(x: Tasks, y: Tasks) -> float:
    r""":math:`P(X > Y)`, the mean over tasks of the share of pairs of runs that x wins; a tie counts one half."""
    wins = []
    for mine, theirs in zip(x, y, strict=True):
        difference = np.asarray(mine, float)[:, None] - np.asarray(theirs, float)
        wins.append((difference > 0).mean() + 0.5 * (difference == 0).mean())
    return float(np.mean(wins))


def improvement(x: Tasks, y: Tasks, *, samples: int = 2_000, seed: int = 0) -> Estimate:
    """:func:`probability_of_improvement` with its interval; the runs of both are drawn anew."""

    def of_both(tasks: Tasks) -> float:
        return probability_of_improvement(tasks[: len(x)], tasks[len(x) :])

    return interval(of_both, [*x, *y], samples=samples, seed=seed)


def performance_profile(tasks: Tasks, thresholds: np.ndarray) -> np.ndarray:
    """Share of the runs whose score is above each threshold ``[K]``, averaged over tasks, ``[K]``."""
    above = [(np.asarray(task, float)[:, None] > thresholds).mean(0) for task in tasks]
    return np.mean(above, axis=0)
