"""Sums over time: discounted sums and advantage estimates. Time is the dimension before the last."""

from __future__ import annotations

import torch
from torch import Tensor

from pgkit.functional.checks import is_flag, same_shape


def discounted_sum(x: Tensor, factor: Tensor) -> Tensor:
    r"""Backward linear recurrence :math:`y_t = x_t + f_t\, y_{t+1}`, with :math:`y_T = 0`.

    A parallel scan: ``ceil(log2 T)`` vectorized steps in place of ``T`` (Hillis and Steele, 1986). Where a factor is 0
    the sum ends: a NaN or an infinity beyond it stays there.

    Args:
        x: ``[*B, T, 1]``.
        factor: ``[*B, T, 1]``, with absolute value at most 1.

    Returns:
        ``[*B, T, 1]``.
    """
    same_shape(x=x, factor=factor)
    steps, shift = x.shape[-2], 1
    while shift < steps:
        # invariant: x_t sums the terms t .. t + shift - 1, factor_t multiplies what follows them
        head, tail = x[..., :-shift, :], x[..., shift:, :]
        weight = factor[..., : steps - shift, :]
        head = torch.where(weight == 0, head, head + weight * tail)  # 0 * inf is NaN
        x = torch.cat([head, x[..., steps - shift :, :]], -2)
        before, after = factor[..., : max(steps - 2 * shift, 0), :], factor[..., shift : steps - shift, :]
        factor = torch.where(before == 0, before, before * after)
        shift *= 2
    return x


def generalized_advantage(
    value: Tensor,
    next_value: Tensor,
    reward: Tensor,
    done: Tensor,
    terminated: Tensor,
    gamma: float | Tensor,
    lmbda: float | Tensor,
) -> tuple[Tensor, Tensor]:
    r"""Generalized advantage estimation (Schulman et al., 2016, https://arxiv.org/abs/1506.02438, eq. 16).

    .. math::
        \delta_t = r_t + \gamma (1 - \text{terminated}_t) V(s'_t) - V(s_t), \qquad
        A_t = \delta_t + \gamma \lambda (1 - \text{done}_t) A_{t+1}

    A termination has no future; a truncation bootstraps with the value of the true final observation
    :math:`s'_t`. The trace stops at both.

    Args:
        value: :math:`V(s_t)`, ``[*B, T, 1]``.
        next_value: :math:`V(s'_t)`, ``[*B, T, 1]``.
        reward: ``[*B, T, 1]``.
        done: boolean ``[*B, T, 1]``, the episode ended here, for either reason.
        terminated: boolean ``[*B, T, 1]``, it ended in a terminal state.
        gamma: discount.
        lmbda: weight of the long traces; 0 is one-step TD, 1 Monte-Carlo.

    Returns:
        The advantage and the value target :math:`A_t + V(s_t)`, both ``[*B, T, 1]``.
    """
    same_shape(value=value, next_value=next_value, reward=reward, done=done, terminated=terminated)
    is_flag(done=done, terminated=terminated)
    delta = reward + gamma * next_value.masked_fill(terminated, 0.0) - value
    advantage = discounted_sum(delta, gamma * lmbda * (~done).to(delta.dtype))
    return advantage, advantage + value
