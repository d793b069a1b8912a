import math

import pytest
import torch

from pgkit.functional import (
    approx_kl,
    clip_surrogate,
    dual_clip_surrogate,
    policy_gradient,
    quadratic_surrogate,
    ratio_surrogate,
    rollback_surrogate,
)


def test_clip_by_hand():
    # ratios 0.5, 1.1, 1.5 with epsilon 0.2; A = 2 then A = -2
    # A = 2:  min(1, 1.6) = 1    min(2.2, 2.2) = 2.2      min(3, 2.4) = 2.4
    # A = -2: min(-1, -1.6) = -1.6   -2.2                 min(-3, -2.4) = -3
    log_ratio = torch.tensor([0.5, 1.1, 1.5], dtype=torch.float64).log()
    two = torch.full_like(log_ratio, 2.0)
    expected = torch.tensor([1.0, 2.2, 2.4], dtype=torch.float64)
    torch.testing.assert_close(clip_surrogate(log_ratio, two, 0.2), expected)
    expected = torch.tensor([-1.6, -2.2, -3.0], dtype=torch.float64)
    torch.testing.assert_close(clip_surrogate(log_ratio, -two, 0.2), expected)


def test_asymmetric_clip():
    log_ratio, one = torch.tensor([math.log(2.0)]), torch.ones(1)
    assert clip_surrogate(log_ratio, one, 0.2, 0.5).item() == pytest.approx(1.5)
    assert clip_surrogate(-log_ratio, -one, 0.1, 0.5).item() == pytest.approx(-0.9)


def test_no_gradient_beyond_the_clip():
    log_ratio = torch.tensor([math.log(1.5), math.log(1.5)], requires_grad=True)
    clip_surrogate(log_ratio, torch.tensor([1.0, -1.0]), 0.2).sum().backward()
    assert log_ratio.grad is not None
    assert log_ratio.grad.tolist() == pytest.approx([0.0, -1.5])


def test_approx_kl_of_two_gaussians():
    # KL(N(0,1) || N(0.1,1)) = 0.005; log ratio of samples from the first: 0.1 x - 0.005
    x = torch.randn(400_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert approx_kl(0.1 * x - 0.005).mean().item() == pytest.approx(0.005, rel=0.02)
    assert (approx_kl(torch.linspace(-2, 2, 9)) >= 0).all()


def test_refuses_to_broadcast():
    with pytest.raises(ValueError, match=r"advantage has shape \(4, 1\) but log_ratio has shape \(4,\)"):
        clip_surrogate(torch.zeros(4), torch.zeros(4, 1))
    for surrogate in (ratio_surrogate, quadratic_surrogate, rollback_surrogate, policy_gradient):
        with pytest.raises(ValueError, match=r"advantage has shape \(4, 1\) but log_\w+ has shape \(4,\)"):
            surrogate(torch.zeros(4), torch.zeros(4, 1))


def objectives(surrogate, *args):
    """Values and slopes in log r at the ratios 0.5, 1, 1.5, 4, with A = 2 and A = -2."""
    log_ratio = torch.tensor([0.5, 1.0, 1.5, 4.0], dtype=torch.float64).log().repeat(2, 1).requires_grad_()
    advantage = torch.tensor([[2.0], [-2.0]], dtype=torch.float64).expand(2, 4)
    value = surrogate(log_ratio, advantage, *args)
    (slope,) = torch.autograd.grad(value.sum(), log_ratio)
    return value.tolist(), slope.tolist()


def test_ratio_and_policy_gradient_by_hand():
    assert objectives(ratio_surrogate)[0] == [pytest.approx([1, 2, 3, 8]), pytest.approx([-1, -2, -3, -8])]
    log_prob, advantage = torch.tensor([-0.5], requires_grad=True), torch.tensor([3.0], requires_grad=True)
    objective = policy_gradient(log_prob, advantage)
    objective.backward()
    assert objective.item() == -1.5 and log_prob.grad is not None
    assert log_prob.grad.item() == 3.0 and advantage.grad is None


def test_dual_clip_by_hand():
    # as the clip for A = 2; for A = -2 never below 3 A = -6: r = 4 gives min(-8, -2.4) = -8, so -6 and no slope
    value, slope = objectives(dual_clip_surrogate, 0.2, 3.0)
    assert value == [pytest.approx([1, 2, 2.4, 2.4]), pytest.approx([-1.6, -2, -3, -6])]
    assert slope == [pytest.approx([1, 2, 0, 0]), pytest.approx([0, -2, -3, 0])]


def test_quadratic_penalty_by_hand():
    # r A - |A| / (2 * 0.2) (r - 1)^2 = r A - 5 (r - 1)^2: A = 2: 1 - 1.25, 2, 3 - 1.25, 8 - 45
    value, slope = objectives(quadratic_surrogate, 0.2)
    assert value == [pytest.approx([-0.25, 2, 1.75, -37]), pytest.approx([-2.25, -2, -4.25, -53])]
    # its slope in log r, r (A - 10 (r - 1)), is zero at 1 + 0.2 for A = 2 and at 1 - 0.2 for A = -2
    assert slope == [pytest.approx([3.5, 2, -4.5, -112]), pytest.approx([1.5, -2, -10.5, -128])]


def test_rollback_by_hand():
    # beyond the clip at 0.8 and 1.2 the slope is -0.3 A: A = 2, r = 1.5: (1.2 - 0.3 * 0.3) * 2 = 2.22; r = 4: 0.72
    # A = -2, r = 0.5: (0.8 + 0.3 * 0.3) * -2 = -1.78; on the other sides the minimum is r A
    value, slope = objectives(rollback_surrogate, 0.2, 0.3)
    assert value == [pytest.approx([1, 2, 2.22, 0.72]), pytest.approx([-1.78, -2, -3, -8])]
    assert slope == [pytest.approx([1, 2, -0.9, -2.4]), pytest.approx([0.3, -2, -3, -8])]
