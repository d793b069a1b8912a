"""V-trace: values and advantages of one policy from trajectories of another."""

from __future__ import annotations

import torch
from torch import Tensor

from pgkit.functional.checks import same_shape
from pgkit.functional.returns import discounted_sum
from pgkit.functional.td_lambda import cuts


def vtrace(
    log_ratio: Tensor,
    value: Tensor,
    next_value: Tensor,
    reward: Tensor,
    done: Tensor,
    terminated: Tensor,
    gamma: float | Tensor,
    lmbda: float | Tensor = 1.0,
    rho_thresh: float | Tensor = 1.0,
    c_thresh: float | Tensor = 1.0,
) -> tuple[Tensor, Tensor]:
    r"""V-trace (Espeholt et al., 2018, https://arxiv.org/abs/1802.01561, eq. 1 and section 4.2).

    .. math::
        \delta_t &= \rho_t \big(r_t + \gamma (1 - \text{terminated}_t) V(s'_t) - V(s_t)\big) \\
        v_t &= V(s_t) + \delta_t + \gamma (1 - \text{done}_t)\, c_t \big(v_{t+1} - V(s_{t+1})\big) \\
        A_t &= \rho_t \big(r_t + \gamma (1 - \text{terminated}_t)
            (\lambda v_{t+1} + (1 - \lambda) V(s'_t)) - V(s_t)\big)

    with :math:`\rho_t = \min(\bar\rho, \pi/\mu)` and :math:`c_t = \lambda \min(\bar c, \pi/\mu)`; at the end of an
    episode and of the rollout :math:`V(s'_t)` stands for :math:`v_{t+1}`. On-policy with thresholds of at least 1,
    :math:`v_t` is the :math:`\lambda`-return and :math:`A_t` is GAE.

    Args:
        log_ratio: :math:`\log \pi(a_t|s_t) - \log \mu(a_t|s_t)`, the present policy against the one that acted,
            ``[*B, T, 1]``.
        value: :math:`V(s_t)`, ``[*B, T, 1]``.
        next_value: :math:`V(s'_t)`, ``[*B, T, 1]``.
        reward: ``[*B, T, 1]``.
        done: boolean ``[*B, T, 1]``, the episode ended here, for either reason.
        terminated: boolean ``[*B, T, 1]``, it ended in a terminal state.
        gamma: discount.
        lmbda: weight of the long traces (remark 2); the paper's is 1.
        rho_thresh: :math:`\bar\rho`, which sets the policy whose value is learned; ``inf``: that of :math:`\pi`.
        c_thresh: :math:`\bar c`, which sets how far the traces reach.

    Returns:
        The advantage :math:`A_t`, importance weight included, and the value target :math:`v_t`, both ``[*B, T, 1]``.
    """
    same_shape(log_ratio=log_ratio, value=value, next_value=next_value)
    cut = cuts(next_value, reward, done, terminated)
    ratio = log_ratio.exp()
    rho, c = ratio.clamp(max=rho_thresh), lmbda * ratio.clamp(max=c_thresh)
    delta = rho * (reward + gamma * next_value.masked_fill(terminated, 0.0) - value)
    excess = discounted_sum(delta, (gamma * c).masked_fill(done, 0.0))
    target = value + excess
    following = torch.cat([target[..., 1:, :], next_value[..., -1:, :]], -2)
    bootstrap = torch.where(cut, next_value, lmbda * following + (1 - lmbda) * next_value)
    return rho * (reward + gamma * bootstrap.masked_fill(terminated, 0.0) - value), target
