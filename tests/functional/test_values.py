import pytest
import torch

from pgkit.functional import clipped_value_loss, explained_variance, standardize, value_loss


def test_squared_error_has_no_half():
    value, target = torch.tensor([3.0]), torch.tensor([1.0])
    assert value_loss(value, target).item() == 4.0
    assert value_loss(value, target, "l1").item() == 2.0
    assert value_loss(value, target, "smooth_l1").item() == 1.5
    assert value_loss(value, target, lambda v, t: (v - t) ** 4).item() == 16.0
    with pytest.raises(ValueError, match="unknown value loss 'huber'"):
        value_loss(value, target, "huber")


def test_value_clipping_takes_the_larger_loss():
    # old 0, clip 0.5. V = 2, target 1: plain (1)^2 = 1, clipped (0.5 - 1)^2 = 0.25 -> 1
    # V = 2, target 3: plain 1, clipped (0.5 - 3)^2 = 6.25 -> 6.25
    value, old = torch.tensor([2.0, 2.0]), torch.zeros(2)
    assert clipped_value_loss(value, torch.tensor([1.0, 3.0]), old, 0.5).tolist() == [1.0, 6.25]


def test_explained_variance():
    target = torch.tensor([1.0, 2.0, 3.0, 4.0])
    assert explained_variance(target, target).item() == 1.0
    assert explained_variance(torch.full((4,), 2.5), target).item() == pytest.approx(0.0)
    assert explained_variance(-target, target).item() == pytest.approx(-3.0)


def test_standardize():
    x = torch.tensor([[1.0], [2.0], [6.0], [50.0]])
    torch.testing.assert_close(standardize(x), (x - x.mean()) / x.std())
    mask = torch.tensor([[True], [True], [True], [False]])
    torch.testing.assert_close(standardize(x, mask)[:3], (x[:3] - 3) / x[:3].std())
    assert standardize(x[:1]).item() == 0  # one row has no deviation
    assert standardize(torch.full((3,), 7.0)).tolist() == [0, 0, 0]


def test_standardize_over_some_dimensions_only():
    # two columns, each with a mean and a deviation of its own; the masked element may be anything
    x = torch.tensor([[1.0, 10.0], [2.0, 30.0], [3.0, float("nan")]])
    mask = torch.tensor([[True, True], [True, True], [True, False]])
    out = standardize(x, mask, dim=(0,))
    torch.testing.assert_close(out[:, 0], torch.tensor([-1.0, 0.0, 1.0]))
    torch.testing.assert_close(out[:2, 1], torch.tensor([-1.0, 1.0]) / 2**0.5)


def test_masked_elements_do_not_reach_an_average():
    value, mask = torch.tensor([1.0, 2.0, float("inf")]), torch.tensor([True, True, False])
    assert explained_variance(value, torch.tensor([1.0, 2.0, 0.0]), mask).item() == 1.0
