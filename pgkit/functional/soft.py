"""Entropy-regularized values, bootstrapped targets and the temperature that weighs the entropy."""

from __future__ import annotations

from torch import Tensor

from pgkit.functional.checks import is_flag, same_shape


def twin_minimum(q: Tensor) -> Tensor:
    r"""The least of the critics' values, :math:`\min_i Q_i` (Fujimoto et al., 2018, https://arxiv.org/abs/1802.09477).

    Args:
        q: ``[*B, critics]``.

    Returns:
        ``[*B]``.
    """
    return q.amin(-1)


def ensemble_mean(q: Tensor) -> Tensor:
    r"""The mean of the critics' values, :math:`\frac1N \sum_i Q_i`, ``[*B, critics] -> [*B]``."""
    return q.mean(-1)


def bootstrap_target(
    reward: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    gamma: float | Tensor,
    steps: Tensor | None = None,
) -> Tensor:
    r""":math:`r + \gamma^n (1 - \text{terminated}) V(s_{t+n})`: truncation bootstraps, termination does not.

    Args:
        reward: ``[*B, 1]``; for ``n > 1`` the discounted sum of the ``n`` rewards.
        next_value: ``[*B, 1]``.
        terminated: boolean ``[*B, 1]``.
        gamma: discount.
        steps: ``[*B, 1]``, the ``n`` of each entry; None: 1.

    Returns:
        ``[*B, 1]``.
    """
    same_shape(reward=reward, next_value=next_value, terminated=terminated)
    is_flag(terminated=terminated)
    discount = gamma if steps is None else gamma**steps
    return reward + discount * next_value * ~terminated


def temperature_loss(log_alpha: Tensor, log_prob: Tensor, target_entropy: float | Tensor) -> Tensor:
    r""":math:`-\log\alpha\,(\log \pi(a|s) + \bar H)`: raises the temperature while the entropy is below its target.

    Haarnoja et al., 2018 (https://arxiv.org/abs/1812.05905, eq. 18), in :math:`\log\alpha` in place of :math:`\alpha`,
    as in the authors' code. No gradient reaches the policy.

    Args:
        log_alpha: scalar.
        log_prob: ``[*B]``.
        target_entropy: :math:`\bar H`, by custom minus the number of action dimensions.

    Returns:
        ``[*B]``.
    """
    return -log_alpha * (log_prob.detach() + target_entropy)
