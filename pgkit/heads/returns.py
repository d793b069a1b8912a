"""A distribution of the return, and the arithmetic that targets need."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgkit.functional import same_shape


@dataclass(frozen=True)
class Returns:
    r"""A distribution of the return for each row: atoms :math:`z_k` with weights :math:`w_k`; a number is one atom.

    Shifted and scaled, it is the distribution of the shifted and scaled return, so that a target reads the same for
    every head: ``reward + gamma * (min_q - alpha * log_prob) * ~terminated``.

    Args:
        atoms: ``[*B, K]``.
        weights: ``[*B, K]``, sums to 1 over ``K``.
    """

    atoms: Tensor
    weights: Tensor

    @classmethod
    def certain(cls, value: Tensor) -> Returns:
        """The return that is ``value [*B]`` with certainty."""
        return cls(value.unsqueeze(-1), torch.ones_like(value).unsqueeze(-1))

    @property
    def shape(self) -> torch.Size:
        """``[*B]``."""
        return self.atoms.shape[:-1]

    @property
    def dtype(self) -> torch.dtype:
        """Of the atoms."""
        return self.atoms.dtype

    @property
    def mean(self) -> Tensor:
        """The expected return, ``[*B]``."""
        return (self.atoms * self.weights).sum(-1)

    def mixed(self) -> Returns:
        """The mixture over the first dimension, the same for all of its rows: ``[copies, *B]`` in and out.

        Its mean is the mean over the copies.
        """
        copies = self.atoms.shape[0]
        atoms, weights = (
            x.movedim(0, -2).flatten(-2).expand(copies, *x.shape[1:-1], -1) for x in (self.atoms, self.weights)
        )
        return Returns(atoms, weights / copies)

    def __add__(self, shift: Tensor) -> Returns:
        return Returns(self.atoms + self._column(shift), self.weights)

    def __sub__(self, shift: Tensor) -> Returns:
        return Returns(self.atoms - self._column(shift), self.weights)

    def __mul__(self, scale: Tensor) -> Returns:
        return Returns(self.atoms * self._column(scale), self.weights)

    __radd__, __rmul__ = __add__, __mul__

    def _column(self, x: Tensor) -> Tensor:
        """One number for all rows as it is, one for each row ``[*B]`` as ``[*B, 1]``."""
        if x.dim() == 0:
            return x
        same_shape(returns=self.atoms[..., 0], number=x)
        return x.unsqueeze(-1)
