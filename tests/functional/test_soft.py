"""Entropy-regularized values, targets and the temperature, in numbers worked out by hand (float64)."""

import math

import pytest
import torch

from pgkit import functional as F
from pgkit.controllers import FixedTemperature, Temperature

column = lambda *x: torch.tensor(x, dtype=torch.float64).unsqueeze(-1)  # noqa: E731


def test_values_of_several_critics():
    atoms = torch.tensor([[2.0, 3.0], [-1.0, 4.0]], dtype=torch.float64)
    assert F.twin_minimum(atoms).tolist() == [2.0, -1.0] and F.ensemble_mean(atoms).tolist() == [2.5, 1.5]


def test_target_bootstraps_unless_terminated():
    # 1 + 0.9 * 10 = 10; terminated: 1; after 3 steps: 1 + 0.729 * 10 = 8.29
    reward, value = column(1, 1, 1), column(10, 10, 10)
    terminated = torch.tensor([[False], [True], [False]])
    target = F.bootstrap_target(reward, value, terminated, 0.9, column(1, 1, 3))
    torch.testing.assert_close(target, column(10.0, 1.0, 8.29))


def test_shapes_and_dtypes_are_refused():
    with pytest.raises(ValueError, match="nothing is broadcast"):
        F.bootstrap_target(torch.zeros(4, 1), torch.zeros(4), torch.zeros(4, 1, dtype=torch.bool), 0.9)
    with pytest.raises(TypeError, match="boolean"):
        F.bootstrap_target(torch.zeros(4, 1), torch.zeros(4, 1), torch.zeros(4, 1), 0.9)


def test_temperature_rises_while_entropy_is_below_its_target():
    # entropy 1 (log-prob -1), target 2: loss = -log_alpha * (-1 + 2), so d loss / d log_alpha = -1: it rises
    block = Temperature(target_entropy=2.0, alpha_init=0.5)
    block.loss(torch.tensor([-1.0])).sum().backward()
    assert block.log_alpha.grad is not None and block.log_alpha.grad.item() == -1.0
    assert block.alpha.item() == pytest.approx(0.5) and not block.alpha.requires_grad
    assert block.loss(torch.tensor([-1.0])).item() == pytest.approx(math.log(2))


def test_temperature_stays_within_its_bounds():
    block = Temperature(-1.0, alpha_init=1.0, min_alpha=0.1, max_alpha=0.5)
    assert block.alpha.item() == pytest.approx(0.5)
    block.log_alpha.data.fill_(-20.0)
    assert block.alpha.item() == pytest.approx(0.1)


def test_fixed_temperature_has_nothing_to_train():
    block = FixedTemperature(0.2)
    assert not list(block.parameters())
    assert block.alpha.item() == pytest.approx(0.2) and block.loss(torch.ones(3)).tolist() == [0, 0, 0]
