"""Returns: lambda-returns (Monte-Carlo at 1) and n-step returns. Time is the dimension before the last."""

from __future__ import annotations

import torch
from torch import Tensor

from pgkit.functional.checks import is_flag, same_shape
from pgkit.functional.returns import discounted_sum


def lambda_return(
    next_value: Tensor,
    reward: Tensor,
    done: Tensor,
    terminated: Tensor,
    gamma: float | Tensor,
    lmbda: float | Tensor,
) -> Tensor:
    r"""The :math:`\lambda`-return (Sutton and Barto, 2018, eq. 12.20); with :math:`\lambda = 1` the Monte-Carlo return.

    .. math::
        G_t = r_t + \gamma \big((1 - \lambda) V(s'_t) + \lambda G_{t+1}\big)

    At a truncation and at the rollout's last step :math:`V(s'_t)` stands for the bracket, at a termination zero.

    Args:
        next_value: :math:`V(s'_t)`, ``[*B, T, 1]``; zeros where there is no critic.
        reward: ``[*B, T, 1]``.
        done: boolean ``[*B, T, 1]``, the episode ended here, for either reason.
        terminated: boolean ``[*B, T, 1]``, it ended in a terminal state.
        gamma: discount.
        lmbda: weight of the long returns.

    Returns:
        ``[*B, T, 1]``.
    """
    cut = cuts(next_value, reward, done, terminated)
    weight = gamma * lmbda * (~cut).to(reward.dtype)
    return discounted_sum(reward + (gamma - weight) * next_value.masked_fill(terminated, 0.0), weight)


def n_step_return(
    next_value: Tensor, reward: Tensor, done: Tensor, terminated: Tensor, gamma: float | Tensor, steps: int
) -> Tensor:
    r"""The n-step return, :math:`\sum_{k<n} \gamma^k r_{t+k} + \gamma^n V(s_{t+n})`.

    It is shorter where an episode or the rollout ends within ``steps``: a truncation and the rollout's end bootstrap
    there, a termination does not. Arguments as in :func:`lambda_return`.
    """
    cut = cuts(next_value, reward, done, terminated)
    value = next_value.masked_fill(terminated, 0.0)
    result = reward + gamma * value
    for _ in range(steps - 1):
        longer = torch.cat([result[..., 1:, :], value[..., -1:, :]], -2)
        result = reward + gamma * torch.where(cut, value, longer)
    return result


def from_start(x: Tensor, done: Tensor) -> Tensor:
    """At every step the value of ``x`` at the first step of its episode within the rollout; all ``[*B, T, 1]``."""
    same_shape(x=x, done=done)
    is_flag(done=done)
    first = torch.cat([torch.ones_like(done[..., :1, :]), done[..., :-1, :]], -2)
    step = torch.arange(x.shape[-2], device=x.device).unsqueeze(-1)
    return x.gather(-2, (first * step).cummax(-2).values)


def cuts(next_value: Tensor, reward: Tensor, done: Tensor, terminated: Tensor) -> Tensor:
    """Boolean ``[*B, T, 1]``: nothing after this step belongs to its return. Checks shapes and dtypes."""
    same_shape(next_value=next_value, reward=reward, done=done, terminated=terminated)
    is_flag(done=done, terminated=terminated)
    cut = done.clone()
    cut[..., -1, :] = True
    return cut
