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
    if score.dim() != 1 or group_size < 2 or len(score) % group_size:
        raise ValueError(f"scores of shape {tuple(score.shape)} are not groups of {group_size}: give [N], N a multiple")
    groups = score.view(-1, group_size)
    advantage = groups - groups.mean(1, keepdim=True)
    if divide:
        advantage = advantage / (groups.std(1, keepdim=True) + 1e-6)
    return advantage.flatten()
