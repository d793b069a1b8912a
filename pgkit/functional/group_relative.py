"""Advantages without a critic: an outcome against those of other attempts at the same task."""

from __future__ import annotations

from torch import Tensor


def group_relative(score: Tensor, group_size: int, divide: bool = True) -> Tensor:
    r"""GRPO's advantage (Shao et al., 2024, https://arxiv.org/abs/2402.03300, section 4.1.2).

    .. math::
        A_i = \frac{R_i - \text{mean}(R)}{\text{std}(R)}

    over the group of :math:`i`.

    Args:
        score: :math:`R`, ``[N]``; ``group_size`` neighbours are a group.
        group_size: attempts at one task, at least 2; divides ``N``.
        divide: by the standard deviation; without it, it is Dr. GRPO's (https://arxiv.org/abs/2503.20783).

    Returns:
        ``[N]``.

    Raises:
        ValueError: the group size does not fit.
    """
    groups = grouped(score, group_size)
    advantage = groups - groups.mean(1, keepdim=True)
    if divide:
        advantage = advantage / (groups.std(1, keepdim=True) + 1e-6)
    return advantage.flatten()


def leave_one_out(score: Tensor, group_size: int) -> Tensor:
    r"""RLOO's advantage, against the others' mean (Ahmadian et al., 2024, https://arxiv.org/abs/2402.14740, eq. 8).

    .. math::
        A_i = R_i - \frac{1}{G - 1} \sum_{j \ne i} R_j

    Args, result and errors as in :func:`group_relative`.
    """
    groups = grouped(score, group_size)
    others = (groups.sum(1, keepdim=True) - groups) / (group_size - 1)
    return (groups - others).flatten()


def batch_relative(score: Tensor, group_size: int) -> Tensor:
    r"""The group's mean and the batch's deviation: a group that nearly always succeeds weighs no more than others.

    .. math::
        A_i = \frac{R_i - \text{mean}(R_{group})}{\text{std}(R_{batch})}

    TRL's ``scale_rewards="batch"`` (Liu et al., 2025, https://arxiv.org/abs/2508.08221). Args, result and errors as in
    :func:`group_relative`.
    """
    return group_relative(score, group_size, divide=False) / (score.std() + 1e-6)


def has_spread(score: Tensor, group_size: int) -> Tensor:
    """Whether the scores of an attempt's group differ, bool ``[N]``: without that they teach nothing."""
    groups = grouped(score, group_size)
    spread = groups.amax(1, keepdim=True) > groups.amin(1, keepdim=True)
    return spread.expand_as(groups).flatten()


def grouped(score: Tensor, group_size: int) -> Tensor:
    """Scores ``[N]`` as ``[N / group_size, group_size]``."""
    if score.dim() != 1 or group_size < 2 or len(score) % group_size:
        raise ValueError(f"scores of shape {tuple(score.shape)} are not groups of {group_size}: give [N], N a multiple")
    return score.view(-1, group_size)
