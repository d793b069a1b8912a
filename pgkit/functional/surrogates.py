"""Policy surrogates: objectives to be maximized, functions of the log-ratio and the advantage."""

from __future__ import annotations

import torch
from torch import Tensor

from pgkit.functional.checks import same_shape

_MOST = 40.0  # a log-ratio: beyond 88, exp is infinite in float32, and its square, in a gradient's norm, beyond 44


def policy_gradient(log_prob: Tensor, advantage: Tensor) -> Tensor:
    r"""The objective :math:`\log \pi(a|s)\, A`, whose gradient is the policy gradient (Sutton et al., 2000).

    Args:
        log_prob: any shape; the gradient flows through it alone.
        advantage: same shape.

    Returns:
        Same shape, unreduced.
    """
    same_shape(log_prob=log_prob, advantage=advantage)
    return log_prob * advantage.detach()


def ratio_surrogate(log_ratio: Tensor, advantage: Tensor) -> Tensor:
    r"""The importance-weighted objective :math:`r A` (Schulman et al., 2015, https://arxiv.org/abs/1502.05477, eq. 14).

    Args and result as in :func:`clip_surrogate`.
    """
    same_shape(log_ratio=log_ratio, advantage=advantage)
    return _ratio(log_ratio) * advantage


def clip_surrogate(
    log_ratio: Tensor,
    advantage: Tensor,
    clip_low: float | Tensor = 0.2,
    clip_high: float | Tensor | None = None,
) -> Tensor:
    r"""PPO's clipped surrogate (Schulman et al., 2017, https://arxiv.org/abs/1707.06347, eq. 7).

    .. math::
        \min\big(r A,\ \text{clip}(r, 1 - \epsilon_{low}, 1 + \epsilon_{high}) A\big), \qquad r = \pi / \pi_{old}

    Args:
        log_ratio: :math:`\log \pi(a|s) - \log \pi_{old}(a|s)`, any shape.
        advantage: same shape.
        clip_low: :math:`\epsilon_{low}`.
        clip_high: :math:`\epsilon_{high}`; ``clip_low`` if None (larger in DAPO, https://arxiv.org/abs/2503.14476).

    Returns:
        Same shape, unreduced; value and gradient are finite for any log-ratio.
    """
    same_shape(log_ratio=log_ratio, advantage=advantage)
    ratio = log_ratio.clamp(max=_MOST).exp()
    clipped = ratio.clamp(1 - clip_low, 1 + (clip_low if clip_high is None else clip_high))
    return torch.minimum(ratio * advantage, clipped * advantage)


def dual_clip_surrogate(
    log_ratio: Tensor, advantage: Tensor, clip: float | Tensor = 0.2, bound: float | Tensor = 3.0
) -> Tensor:
    r"""The clipped surrogate, bounded below by :math:`c A` where :math:`A < 0` (Ye et al., 2020).

    Without it a large ratio at a negative advantage makes an objective without bound (https://arxiv.org/abs/1912.09729,
    eq. 5). ``bound`` is :math:`c > 1`; the other arguments and the result are as in :func:`clip_surrogate`.
    """
    objective = clip_surrogate(log_ratio, advantage, clip)
    return torch.where(advantage < 0, torch.maximum(objective, bound * advantage), objective)


def quadratic_surrogate(log_ratio: Tensor, advantage: Tensor, epsilon: float | Tensor = 0.2) -> Tensor:
    r"""SPO's quadratic penalty in place of the clip (Xie et al., 2024, https://arxiv.org/abs/2401.16025).

    .. math::
        r A - \frac{|A|}{2 \epsilon} (r - 1)^2

    The maximum over :math:`r` is at :math:`1 + \epsilon\, \text{sign}(A)`, and beyond it the gradient leads back. Args
    and result as in :func:`clip_surrogate`.
    """
    same_shape(log_ratio=log_ratio, advantage=advantage)
    ratio = _ratio(log_ratio, _MOST / 2)  # it is squared
    return ratio * advantage - advantage.abs() / (2 * epsilon) * (ratio - 1).square()


def rollback_surrogate(
    log_ratio: Tensor, advantage: Tensor, epsilon: float | Tensor = 0.2, slope: float | Tensor = 0.3
) -> Tensor:
    r"""Truly PPO's rollback: beyond the clip the objective falls again.

    Wang et al., 2019 (https://arxiv.org/abs/1903.07940).

    .. math::
        \min\big(r A,\ (\bar r - \alpha (r - \bar r)) A\big), \qquad \bar r = \text{clip}(r, 1 - \epsilon, 1 + \epsilon)

    ``slope`` is :math:`\alpha`; 0 is the clip. The other arguments and the result are as in :func:`clip_surrogate`.
    """
    same_shape(log_ratio=log_ratio, advantage=advantage)
    ratio = _ratio(log_ratio)
    clipped = ratio.clamp(1 - epsilon, 1 + epsilon)
    return torch.minimum(ratio * advantage, (clipped - slope * (ratio - clipped)) * advantage)


def approx_kl(log_ratio: Tensor) -> Tensor:
    r"""Estimate of :math:`KL(\pi_{old} \| \pi)` from samples of :math:`\pi_{old}`: :math:`(r - 1) - \log r`.

    Unbiased and never negative (Schulman, "Approximating KL divergence", 2020, estimator k3). Any shape, unreduced.
    """
    return torch.expm1(log_ratio.clamp(max=_MOST)) * _beyond(log_ratio, _MOST) - log_ratio


def _ratio(log_ratio: Tensor, most: float = _MOST) -> Tensor:
    """``exp(log_ratio)``, continued from ``most`` on by its tangent: value and gradient are finite, and rise."""
    return log_ratio.clamp(max=most).exp() * _beyond(log_ratio, most)


def _beyond(log_ratio: Tensor, most: float) -> Tensor:
    return 1 + (log_ratio - most).clamp(min=0)
