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
    atoms, weights = head.pool(out)
    assert atoms.shape == weights.shape and atoms.shape[:2] == (4, 5)
    torch.testing.assert_close(weights.sum(-1), torch.ones(4, 5, dtype=torch.float64))
    assert head.loss(out, atoms, weights).shape == (4, 5, 3)


@pytest.mark.parametrize("head", HEADS, ids=lambda head: type(head).__name__)
def test_it_learns_the_target_s_mean(head):
    out = torch.zeros(1, 2, head.size, dtype=torch.float64, requires_grad=True)
    atoms = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    weights = torch.full_like(atoms, 0.5)
    if len(head.pool(out)[0][0]) == 1:
        atoms, weights = torch.full((1, 1), 1.5, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    optimizer = torch.optim.Adam([out], lr=0.05)
    for _ in range(600):
        loss = head.loss(out, atoms, weights).sum()
        (out.grad,) = torch.autograd.grad(loss, out)
        optimizer.step()
    assert head.mean(out).tolist() == [[pytest.approx(1.5, abs=0.03)] * 2]


def test_scalar_takes_the_least_critic():
    out = torch.tensor([[[3.0], [1.0]], [[0.0], [5.0]]])
    atoms, _ = heads.Scalar().pool(out)
    assert atoms.tolist() == [[1.0], [0.0]]
    assert heads.Scalar("l1").loss(out, atoms, torch.ones_like(atoms)).tolist() == [[2.0, 0.0], [0.0, 5.0]]


def test_quantiles_are_pooled_sorted_and_truncated_together():
    # two critics of three: 1 2 9 and 3 4 5; one left out for each critic: the two largest of all, 9 and 5
    atoms, weights = heads.Quantiles(3, drop=1).pool(torch.tensor([[[9.0, 1.0, 2.0], [3.0, 5.0, 4.0]]]))
    assert atoms.tolist() == [[1.0, 2.0, 3.0, 4.0]] and weights.tolist() == [[0.25] * 4]


def test_categorical_takes_the_distribution_of_the_critic_with_the_least_mean():
    head = heads.Categorical(0, 2, 3)
    likely = lambda *p: torch.tensor(p).log()  # noqa: E731
    out = torch.stack([likely(0.2, 0.2, 0.6), likely(0.5, 0.0, 0.5)])[None]  # means 1.4 and 1
    atoms, weights = head.pool(out)
    assert atoms.tolist() == [[0.0, 1.0, 2.0]]
    torch.testing.assert_close(weights, torch.tensor([[0.5, 0.0, 0.5]]))


def test_bins_take_the_least_of_the_means():
    out = torch.tensor([[[0.2, 0.2, 0.6], [0.5, 0.0, 0.5]]]).log()
    atoms, _ = heads.Bins(0, 2, 3).pool(out)
    torch.testing.assert_close(atoms, torch.tensor([[1.0]]))


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
