"""Distributions of returns: values by hand, and the same numbers from plain loops in float64."""

from math import erf, sqrt

import pytest
import torch

from pgkit import functional as F


def t(*values):
    return torch.tensor(values, dtype=torch.float64)


def test_quantile_huber_by_hand():
    # tau = 1/4, 3/4. z = 1: differences 1, -1; Huber 1/2, 1/2; slopes 1/4, |3/4 - 1| = 1/4 -> (1/8 + 1/8) / 2 = 1/8
    # z = 4: differences 4, 2; Huber 4 - 1/2, 2 - 1/2; slopes 1/4, 3/4 -> (7/8 + 9/8) / 2 = 1. Half of each: 9/16
    loss = F.quantile_huber(t(0, 2)[None], t(1, 4)[None], t(0.5, 0.5)[None])
    torch.testing.assert_close(loss, t(9 / 16))


@pytest.mark.parametrize("kappa", [1.0, 0.3])
def test_quantile_huber_is_the_double_sum(kappa):
    theta, atoms = torch.randn(3, 4, 5, dtype=torch.float64), torch.randn(3, 4, 7, dtype=torch.float64)
    weights = torch.rand(3, 4, 7, dtype=torch.float64).softmax(-1)
    loss = F.quantile_huber(theta, atoms, weights, kappa)
    for i in range(3):
        for j in range(4):
            total = 0.0
            for n in range(5):
                for k in range(7):
                    delta = float(atoms[i, j, k] - theta[i, j, n])
                    huber = 0.5 * delta**2 if abs(delta) <= kappa else kappa * (abs(delta) - kappa / 2)
                    slope = abs((2 * n + 1) / 10 - (delta < 0))
                    total += float(weights[i, j, k]) * slope * huber / kappa / 5
            assert loss[i, j].item() == pytest.approx(total, abs=1e-12)


def test_its_minimum_is_at_the_quantiles():
    # a straight line of atoms 0 .. 1 and a small kappa: theta = tau has gradient 0, and a push to either side is felt
    atoms = torch.linspace(0, 1, 4001, dtype=torch.float64)[None]
    for shift, sign in ((0.0, 0), (0.05, 1), (-0.05, -1)):
        theta = (t(0.125, 0.375, 0.625, 0.875) + shift)[None].requires_grad_()
        grad = torch.autograd.grad(F.quantile_huber(theta, atoms, torch.full_like(atoms, 1 / 4001), 1e-4).sum(), theta)[
            0
        ]
        assert (grad.abs() < 1e-3).all() if sign == 0 else (grad * sign > 1e-3).all()


def test_two_hot_by_hand():
    support = t(0, 1, 2)
    expected = torch.stack([t(0.75, 0.25, 0), t(0, 0, 1), t(1, 0, 0), t(0, 1, 0)])
    torch.testing.assert_close(F.two_hot(t(0.25, 5, -3, 1), support), expected)


def test_hl_gauss_by_hand():
    # sigma 1/2 around 1: edges at -3, -1, 1, 3 deviations: 0.0013499, 0.1586553, 0.8413447, 0.9986501
    inside = 0.9986501 - 0.0013499
    expected = t((0.1586553 - 0.0013499) / inside, (0.8413447 - 0.1586553) / inside, (0.1586553 - 0.0013499) / inside)
    torch.testing.assert_close(F.hl_gauss(t(1), t(0, 1, 2), 0.5)[0], expected, atol=1e-6, rtol=0)


def test_hl_gauss_is_the_mass_of_each_bin():
    support, value = torch.linspace(-2, 3, 11, dtype=torch.float64), torch.randn(6, dtype=torch.float64) * 3
    probabilities = F.hl_gauss(value, support)
    for i in range(6):
        x = min(max(float(value[i]), -2.0), 3.0)
        cdf = [0.5 * (1 + erf((-2.25 + 0.5 * j - x) / (0.75 * 0.5 * sqrt(2)))) for j in range(12)]
        for j in range(11):
            expected = (cdf[j + 1] - cdf[j]) / (cdf[-1] - cdf[0])
            assert probabilities[i, j].item() == pytest.approx(expected, abs=1e-12)


def test_categorical_projection_by_hand():
    # 0.5 lies half way between 0 and 1: 0.2 to each; 3 is beyond the end: 0.6 to 2
    torch.testing.assert_close(
        F.categorical_projection(t(0.5, 3)[None], t(0.4, 0.6)[None], t(0, 1, 2))[0], t(0.2, 0.2, 0.6)
    )


def test_categorical_projection_is_c51_s_loop_and_keeps_the_mean():
    support = torch.linspace(-1, 2, 7, dtype=torch.float64)
    atoms, weights = torch.randn(5, 9, dtype=torch.float64), torch.randn(5, 9, dtype=torch.float64).softmax(-1)
    got = F.categorical_projection(atoms, weights, support)
    for i in range(5):
        m = [0.0] * 7
        for k in range(9):
            b = (min(max(float(atoms[i, k]), -1.0), 2.0) + 1) / 0.5
            low = min(int(b), 5)
            m[low] += float(weights[i, k]) * (low + 1 - b)
            m[low + 1] += float(weights[i, k]) * (b - low)
        torch.testing.assert_close(got[i], t(*m))
    clipped = (atoms.clamp(-1, 2) * weights).sum(-1)
    torch.testing.assert_close((got * support).sum(-1), clipped)


def test_cross_entropy_and_mean_of_logits():
    # softmax(log 1, log 3) = 1/4, 3/4: -(0.5 log 0.25 + 0.5 log 0.75), mean 0.25 * 2 + 0.75 * 6 = 5
    logits = t(1, 3).log()[None]
    torch.testing.assert_close(F.cross_entropy(logits, t(0.5, 0.5)[None]), -0.5 * (t(0.25).log() + t(0.75).log()))
    torch.testing.assert_close(F.categorical_mean(logits, t(2, 6)), t(5))


def test_a_random_subset_is_even():
    torch.manual_seed(0)
    counts = torch.zeros(5)
    for _ in range(4000):
        subset = F.random_subset(5, 2)
        assert subset.shape == (2,) and subset[0] != subset[1]
        counts[subset] += 1
    assert (counts / 4000 - 0.4).abs().max() < 0.04  # each with probability 2/5, five standard deviations


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="weights has shape"):
        F.quantile_huber(torch.zeros(2, 3), torch.zeros(2, 4), torch.zeros(2, 5))
    with pytest.raises(ValueError, match="batch_of_atoms has shape"):
        F.quantile_huber(torch.zeros(2, 3), torch.zeros(1, 4), torch.zeros(1, 4))
    with pytest.raises(ValueError, match="from 1 to 3"):
        F.random_subset(3, 4)
