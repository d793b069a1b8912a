"""Smoothing of a deterministic policy's target."""

from __future__ import annotations

import torch
from torch import Tensor


def smoothed_action(
    action: Tensor, std: float | Tensor, clip: float | Tensor, low: float | Tensor, high: float | Tensor
) -> Tensor:
    r""":math:`\text{clip}(a + \text{clip}(\sigma \epsilon, \pm c), low, high)` with :math:`\epsilon \sim N(0, 1)`.

    Target policy smoothing (Fujimoto et al., 2018, https://arxiv.org/abs/1802.09477, eq. 14 and 15): actions close to
    one another get values close to one another.

    Args:
        action: ``[*B, actions]``.
        std: :math:`\sigma`, a number or ``[actions]``.
        clip: :math:`c`, likewise.
        low, high: bounds of the action, likewise.

    Returns:
        ``[*B, actions]``.
    """
    noise = (std * torch.randn_like(action)).clamp(-clip, clip)
    return (action + noise).clamp(low, high)
