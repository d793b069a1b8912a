"""Sums over blocks of an array, in tensor operations: TorchRL 0.14's C++ trees do not load under torch 2.13."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pgkit.errors import UserError

BLOCK = 64


class SumTree:
    """``size`` non-negative numbers, zero at first, and the sums over blocks of 64 of them: a tree of two levels.

    Setting ``B`` numbers takes a few vectorized operations, which may be compiled; finding them one more, a running sum
    over all blocks: 16,000 numbers for a million. The sums are made anew from the numbers under them, so that rounding
    errors do not pile up.

    Attributes:
        values: the numbers, padded with zeros to a multiple of 64.
        sums: of each block.
    """

    def __init__(self, size: int, device: torch.device | str = "cpu") -> None:
        blocks = -(-size // BLOCK)
        self.values = torch.zeros(blocks * BLOCK, dtype=torch.float64, device=device)
        self.sums = torch.zeros(blocks, dtype=torch.float64, device=device)

    def set(self, index: Tensor, value: Tensor | float) -> None:
        """Sets the numbers at ``index [B]`` (of equal indices, one wins)."""
        index = index.to(self.values.device)
        self.values[index] = value
        block = index // BLOCK
        self.sums[block] = self.values.view(-1, BLOCK)[block].sum(-1)

    def find(self, share: Tensor) -> Tensor:
        """For shares of the total, ``[B]`` in [0, 1): the index where the running sum first exceeds each."""
        total = self.sums.sum()
        if not math.isfinite(total):
            raise UserError(f"the replay's priorities sum to {total:g}: training diverged, lower the learning rates")
        block, mass = _find(self.sums.cumsum(0), share.double() * total)
        inner = self.values.view(-1, BLOCK)[block].cumsum(-1)
        child, _ = _find(inner, mass.unsqueeze(-1))
        return block * BLOCK + child.squeeze(-1)


def _find(ends: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
    """Where the running sums ``ends [*B, n]`` first exceed each mass ``[*B, m]``, and what is left of it there."""
    mass = torch.minimum(mass, ends[..., -1:] * (1 - 1e-12))  # never past the last number
    where = torch.searchsorted(ends, mass, right=True)
    before = ends.gather(-1, (where - 1).clamp_min(0))
    return where, mass - torch.where(where > 0, before, 0.0)
