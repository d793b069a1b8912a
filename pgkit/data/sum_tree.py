"""A tree of sums over an array, in tensor operations: TorchRL 0.14's C++ trees do not load under torch 2.13."""

from __future__ import annotations

import torch
from torch import Tensor

FANOUT = 64


class SumTree:
    """``size`` non-negative numbers, zero at first, and the sums over blocks of 64, 64², ...: four levels a million.

    Setting or finding ``B`` numbers takes a few vectorized operations a level, which may be compiled. The sums are made
    anew from the numbers under them, so that rounding errors do not pile up.
    """

    def __init__(self, size: int) -> None:
        self.levels: list[Tensor] = []
        while not self.levels or size > 1:
            blocks = -(-size // FANOUT)
            self.levels.append(torch.zeros(blocks * FANOUT, dtype=torch.float64))
            size = blocks

    @property
    def values(self) -> Tensor:
        """The numbers, padded with zeros to a multiple of 64."""
        return self.levels[0]

    def set(self, index: Tensor, value: Tensor | float) -> None:
        """Sets the numbers at ``index [B]`` (of equal indices, one wins)."""
        self.levels[0][index] = value
        for lower, upper in zip(self.levels, self.levels[1:], strict=False):
            index = index // FANOUT
            upper[index] = lower.view(-1, FANOUT)[index].sum(-1)

    def find(self, share: Tensor) -> Tensor:
        """For shares of the total, ``[B]`` in [0, 1): the index where the running sum first exceeds each."""
        mass = share.double() * self.levels[-1].sum()
        node = torch.zeros_like(mass, dtype=torch.int64)
        for level in reversed(self.levels):
            sums = level.view(-1, FANOUT)[node].cumsum(-1)
            mass = torch.minimum(mass, sums[:, -1] * (1 - 1e-12)).unsqueeze(-1)  # never past the last number
            child = torch.searchsorted(sums, mass, right=True)
            before = torch.where(child > 0, sums.gather(-1, (child - 1).clamp_min(0)), 0.0)
            mass, node = (mass - before).squeeze(-1), node * FANOUT + child.squeeze(-1)
        return node
