"""Value heads: what the outputs mean, what the target is, what they learn."""

from functools import partial

import pytest
import torch

from pgkit import functional, heads
from pgkit.errors import UserError

HEADS = [
    heads.Scalar(),
    heads.Quantiles(11, drop=2),
    heads.Bins(-4, 6, 51),
    heads.Bins(-4, 6, 51, project=functional.two_hot),
    heads.Categorical(-4, 6, 51),
]


@pytest.mark.parametrize("head", HEADS, ids=lambda head: type(head).__name__)
def test_the_seam(head):
    assert isinstance(head, heads.Head)
    out = torch.randn(4, 5, 3, head.size, dtype=torch.float64)
    assert head.mean(out).shape == (4, 5, 3)
    for returns in (head.least(out), head.returns(out[..., 0, :])):
        assert returns.atoms.shape == returns.weights.shape and returns.shape == (4, 5)
        torch.testing.assert_close(returns.weights.sum(-1), torch.ones(4, 5, dtype=torch.float64))
        assert head.loss(out, returns).shape == (4, 5, 3)
    alone = out[..., :1, :]  # the least of one critic is that critic
    torch.testing.assert_close(head.least(alone).atoms, head.returns(out[..., 0, :]).atoms)
    torch.testing.assert_close(head.least(alone).weights, head.returns(out[..., 0, :]).weights)


@pytest.mark.parametrize("head", HEADS, ids=lambda head: type(head).__name__)
def test_it_learns_the_target_s_mean(head):
    out = torch.zeros(1, 2, head.size, dtype=torch.float64, requires_grad=True)
    atoms = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    target = heads.Returns(atoms, torch.full_like(atoms, 0.5))
    optimizer = torch.optim.Adam([out], lr=0.05)
    for _ in range(600):
        loss = head.loss(out, target).sum()
        (out.grad,) = torch.autograd.grad(loss, out)
        optimizer.step()
    assert head.mean(out).tolist() == [[pytest.approx(1.5, abs=0.03)] * 2]


def test_scalar_takes_the_least_critic():
    out = torch.tensor([[[3.0], [1.0]], [[0.0], [5.0]]])
    least = heads.Scalar().least(out)
    assert least.atoms.tolist() == [[1.0], [0.0]]
    assert heads.Scalar("l1").loss(out, least).tolist() == [[2.0, 0.0], [0.0, 5.0]]


def test_quantiles_are_pooled_sorted_and_truncated_together():
    # two critics of three: 1 2 9 and 3 4 5; one left out for each critic: the two largest of all, 9 and 5
    pooled = heads.Quantiles(3, drop=1).least(torch.tensor([[[9.0, 1.0, 2.0], [3.0, 5.0, 4.0]]]))
    assert pooled.atoms.tolist() == [[1.0, 2.0, 3.0, 4.0]] and pooled.weights.tolist() == [[0.25] * 4]


def test_categorical_takes_the_distribution_of_the_critic_with_the_least_mean():
    head = heads.Categorical(0, 2, 3)
    likely = lambda *p: torch.tensor(p).log()  # noqa: E731
    out = torch.stack([likely(0.2, 0.2, 0.6), likely(0.5, 0.0, 0.5)])[None]  # means 1.4 and 1
    least = head.least(out)
    assert least.atoms.tolist() == [[0.0, 1.0, 2.0]]
    torch.testing.assert_close(least.weights, torch.tensor([[0.5, 0.0, 0.5]]))


def test_bins_take_the_least_of_the_means():
    out = torch.tensor([[[0.2, 0.2, 0.6], [0.5, 0.0, 0.5]]]).log()
    torch.testing.assert_close(heads.Bins(0, 2, 3).least(out).atoms, torch.tensor([[1.0]]))


@pytest.mark.parametrize(
    "make",
    [
        partial(heads.Quantiles, 3, drop=3),
        partial(heads.Quantiles, kappa=0.0),
        partial(heads.Bins, 1, 1),
        partial(heads.Categorical, 0, 1, 1),
    ],
)
def test_settings_that_mean_nothing_are_refused(make):
    with pytest.raises(UserError):
        make()


def test_returns_are_shifted_and_scaled_as_a_target_says():
    # z = 1 or 3 with weights 1/4 and 3/4, mean 2.5: 0.5 + 2 (z - 1) is 0.5 or 4.5, mean 3.5; a row that has ended: 0.5
    column = lambda *x: torch.tensor(x, dtype=torch.float64)  # noqa: E731
    z = heads.Returns(column([1.0, 3.0], [1.0, 3.0]), column([0.25, 0.75], [0.25, 0.75]))
    reward, two, ended = column(0.5, 0.5), torch.tensor(2.0), torch.tensor([False, True])
    target = reward + two * (z - column(1.0, 1.0)) * ~ended
    assert target.atoms.tolist() == [[0.5, 4.5], [0.5, 0.5]] and target.mean.tolist() == [3.5, 0.5]
    assert z.mean.tolist() == [2.5, 2.5] and z.shape == (2,) and z.dtype == torch.float64
    for other in (reward + z, z + reward):
        assert other.atoms.tolist() == [[1.5, 3.5], [1.5, 3.5]]
    for other in (two * z, z * two):
        assert other.atoms.tolist() == [[2.0, 6.0], [2.0, 6.0]]
    with pytest.raises(ValueError, match="number has shape"):
        z + reward.unsqueeze(-1)


def test_a_mixture_over_the_first_dimension_has_all_atoms_with_equal_shares():
    atoms = torch.tensor([[[1.0, 2.0], [5.0, 6.0]], [[3.0, 4.0], [7.0, 8.0]]])  # two copies of two rows
    mixed = heads.Returns(atoms, torch.tensor([0.25, 0.75]).expand_as(atoms)).mixed()
    rows = [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]]
    assert mixed.atoms.tolist() == [rows, rows] and mixed.weights.tolist() == [[[0.125, 0.375] * 2] * 2] * 2
    assert mixed.mean.tolist() == [[2.75, 6.75]] * 2  # the means of the copies: 1.75 and 3.75, 5.75 and 7.75
