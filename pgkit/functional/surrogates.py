"""Policy surrogates: objectives to be maximized, functions of the log-ratio and the advantage."""

from __future__ import annotations

import torch
from torch import Tensor

from pgkit.functional.checks import same_shape


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
        Same shape, unreduced.
    """
    same_shape(log_ratio=log_ratio, advantage=advantage)
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip_low, 1 + (clip_low if clip_high is None else clip_high))
    return torch.minimum(ratio * advantage, clipped * advantage)


def approx_kl(log_ratio: Tensor) -> Tensor:
    r"""Estimate of :math:`KL(\pi_{old} \| \pi)` from samples of :math:`\pi_{old}`: :math:`(r - 1) - \log r`.

    Unbiased and never negative (Schulman, "Approximating KL divergence", 2020, estimator k3). Any shape, unreduced.
    """
    return torch.expm1(log_ratio) - log_ratio
