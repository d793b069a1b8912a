"""One number a critic: the expected return."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgkit.functional import value_loss


@dataclass(frozen=True)
class Scalar:
    """The expected return; the target is the least of the critics (Fujimoto et al., 2018, https://arxiv.org/abs/1802.09477).

    Args:
        distance: ``l2`` (squared error), ``l1`` or ``smooth_l1``.
    """

    distance: str = "l2"
    size: int = 1

    def mean(self, out: Tensor) -> Tensor:
        """``[*B, critics, 1] -> [*B, critics]``."""
        return out.squeeze(-1)

    def pool(self, out: Tensor) -> tuple[Tensor, Tensor]:
        """One atom: the least of the critics."""
        least = out.amin(-2)
        return least, torch.ones_like(least)

    def loss(self, out: Tensor, atoms: Tensor, weights: Tensor) -> Tensor:
        """Distance of each critic from the one atom."""
        return value_loss(out, atoms.unsqueeze(-2).expand_as(out), self.distance).squeeze(-1)
