"""Random members of an ensemble."""

from __future__ import annotations

import torch
from torch import Tensor


def random_subset(total: int, size: int, device: torch.device | None = None) -> Tensor:
    """``size`` different numbers below ``total``, drawn anew at every call, in random order: ``[size]``.

    REDQ's subset of critics (Chen et al., 2021, https://arxiv.org/abs/2101.05982, algorithm 1).

    Raises:
        ValueError: ``size`` is not between 1 and ``total``.
    """
    if not 1 <= size <= total:
        raise ValueError(f"a random subset of {size} of {total}: give a number from 1 to {total}")
    return torch.randperm(total, device=device)[:size]
