import math

import pytest
import torch

from pgkit.functional import approx_kl, clip_surrogate


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
