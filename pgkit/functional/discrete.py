"""Soft values of discrete actions: all of them weighed, or one drawn with a gradient."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from pgkit.functional.checks import same_shape


def expected_soft_value(weights: Tensor, log_prob: Tensor, value: Tensor, alpha: float | Tensor) -> Tensor:
    r""":math:`\sum_a w_a (Q(s, a) - \alpha \log \pi(a|s))`, a state's value under entropy regularization.

    With :math:`w = \pi(\cdot|s)` it is the expectation over the policy (Christodoulou, 2019,
    https://arxiv.org/abs/1910.07207, eq. 10), with a one-hot :math:`w \sim \pi(\cdot|s)` an estimate from one action.

    Args:
        weights: :math:`w`, ``[*B, actions]``.
        log_prob: ``[*B, actions]``, log-probability of every action.
        value: :math:`Q(s, \cdot)`, ``[*B, actions]``.
        alpha: temperature.

    Returns:
        ``[*B]``.
    """
    same_shape(weights=weights, log_prob=log_prob, value=value)
    return (weights * (value - alpha * log_prob)).sum(-1)


def straight_through_sample(logits: Tensor, tau: float | Tensor = 1.0) -> Tensor:
    r"""A one-hot draw from :math:`\text{softmax}(logits)` with the gradient of its relaxation.

    .. math:: y = \text{softmax}\big((logits + g) / \tau\big), \quad g_a \sim \text{Gumbel}(0, 1), \qquad
              \text{onehot}(\text{argmax} y) + y - \text{stopgrad}(y)

    Jang et al., 2017 (https://arxiv.org/abs/1611.01144): the forward pass is the draw itself, the backward pass that of
    :math:`y`, whose bias falls and whose variance rises as :math:`\tau \to 0`.

    Args:
        logits: ``[*B, actions]``.
        tau: :math:`\tau`, above 0.

    Returns:
        ``[*B, actions]``.
    """
    return F.gumbel_softmax(logits, tau, hard=True)  # pyright: ignore[reportArgumentType]
