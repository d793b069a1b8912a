"""Coefficients that follow what they are to control."""

from __future__ import annotations

import torch
from torch import Tensor


def adapted_coefficient(
    coefficient: Tensor, kl: Tensor, target: float, increment: float = 2.0, decrement: float = 0.5, band: float = 1.5
) -> Tensor:
    r"""PPO's rule for the weight of its KL penalty (Schulman et al., 2017, https://arxiv.org/abs/1707.06347, eq. 8).

    .. math::
        \beta' = 2 \beta \text{ if } d > 1.5\, d_{targ}, \qquad \tfrac12 \beta \text{ if } d < d_{targ} / 1.5, \qquad
        \beta \text{ otherwise}

    Args:
        coefficient: :math:`\beta`, a scalar.
        kl: :math:`d`, a scalar.
        target: :math:`d_{targ}`.
        increment, decrement: the factors 2 and 1/2.
        band: the factor 1.5.

    Returns:
        A scalar.
    """
    raised = torch.where(kl > band * target, coefficient * increment, coefficient)
    return torch.where(kl < target / band, coefficient * decrement, raised)
