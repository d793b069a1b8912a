"""Values by hand, by the definitions of Agarwal et al. (2021)."""

import itertools

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from pgkit.errors import UserError
from pgkit.run import statistics


def test_the_interquartile_mean_weighs_the_middle_half_of_all_runs():
    assert statistics.iqm([[1, 100, 3, 4], [5, 6, -50, 8]]) == pytest.approx((3 + 4 + 5 + 6) / 4)
    assert statistics.iqm([[1, 2, 3, 4, 50]]) == 3  # of five, one goes at either end: 2, 3, 4 stay


def test_the_interval_is_that_of_all_resamples():
    runs = [0.0, 1.0, 5.0]
    means = [np.mean(drawn) for drawn in itertools.product(runs, repeat=3)]
    low, high = np.percentile(np.repeat(means, 1_000), [2.5, 97.5])
    estimate = statistics.interval(lambda tasks: float(np.mean(tasks[0])), [runs], samples=20_000)
    assert estimate.value == 2
    assert estimate.low == pytest.approx(low, abs=0.1) and estimate.high == pytest.approx(high, abs=0.1)


def test_the_bootstrap_draws_within_each_task():
    tasks = [[1.0, 1.0, 1.0], [9.0, 9.0]]  # no spread within a task: none in any resample
    assert statistics.interval(statistics.iqm, tasks)[1:] == (statistics.iqm(tasks),) * 2


def test_the_probability_of_improvement_counts_pairs_and_halves_ties():
    assert statistics.probability_of_improvement([[1, 2, 3]], [[0, 2]]) == pytest.approx(4.5 / 6)
    assert statistics.probability_of_improvement([[1], [1]], [[0], [2]]) == 0.5
    x, y = np.random.default_rng(1).integers(0, 9, (2, 12))
    assert statistics.probability_of_improvement([x], [y]) == pytest.approx(mannwhitneyu(x, y).statistic / 144)


def test_a_profile_is_the_share_of_runs_above_a_threshold():
    profile = statistics.performance_profile([[0.2, 0.8], [0.5, 0.5]], np.array([0.0, 0.4, 0.5, 0.9]))
    assert profile.tolist() == [1.0, 0.75, 0.25, 0.0]


def test_a_task_without_runs_is_named():
    with pytest.raises(UserError, match="at least one run"):
        statistics.interval(statistics.iqm, [[1.0], []])
