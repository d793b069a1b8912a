"""One number a critic: the expected return."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pgkit.functional import value_loss
from pgkit.heads.returns import Returns


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

    def returns(self, out: Tensor) -> Returns:
        """The one number, with certainty."""
        return Returns.certain(out.squeeze(-1))

    def least(self, out: Tensor) -> Returns:
        """The least of the critics."""
        return self.returns(out.amin(-2))

    def loss(self, out: Tensor, target: Returns) -> Tensor:
        """Distance of each critic from the target's mean."""
        return value_loss(out, target.mean[..., None, None].expand_as(out), self.distance).squeeze(-1)
