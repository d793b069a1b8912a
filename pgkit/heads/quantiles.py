"""Quantiles of the return."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgkit.errors import UserError
from pgkit.functional import quantile_huber
from pgkit.heads.returns import Returns


@dataclass(frozen=True)
class Quantiles:
    """Quantiles of the return; the target pools all critics' atoms and leaves the largest out.

    Kuznetsov et al., 2020 (https://arxiv.org/abs/2005.04269, section 3): few atoms more or less tune the
    overestimation finely, where a minimum over critics is all or nothing.

    Args:
        size: quantiles of each critic.
        drop: atoms left out of the target for each critic.
        kappa: width of the Huber distance's square part.
    """

    size: int = 25
    drop: int = 2
    kappa: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.drop < self.size:
            raise UserError(f"drop={self.drop} of {self.size} quantiles: it must leave at least one")
        if self.kappa <= 0:
            raise UserError(f"kappa={self.kappa}: give a width above 0")

    def mean(self, out: Tensor) -> Tensor:
        """``[*B, critics, size] -> [*B, critics]``."""
        return out.mean(-1)

    def returns(self, out: Tensor) -> Returns:
        """The critic's atoms, sorted, without the ``drop`` largest."""
        return self.least(out.unsqueeze(-2))

    def least(self, out: Tensor) -> Returns:
        """All critics' atoms, sorted, without the ``drop * critics`` largest; a ``UserError`` if none is left."""
        if self.drop >= out.shape[-1]:
            raise UserError(f"drop={self.drop} of {out.shape[-1]} quantiles of each critic: it must leave at least one")
        atoms = out.flatten(-2).sort(-1).values
        atoms = atoms[..., : atoms.shape[-1] - self.drop * out.shape[-2]]
        return Returns(atoms, torch.full_like(atoms, 1 / atoms.shape[-1]))

    def loss(self, out: Tensor, target: Returns) -> Tensor:
        """Quantile regression of each critic towards all the target's atoms."""
        shape = (*out.shape[:-1], target.atoms.shape[-1])
        atoms, weights = (x.unsqueeze(-2).expand(shape) for x in (target.atoms, target.weights))
        return quantile_huber(out, atoms, weights, self.kappa)
