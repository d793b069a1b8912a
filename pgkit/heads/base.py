"""The seam between a critic's network and the loss that trains it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
class Head(Protocol):
    """What ``size`` outputs of each critic stand for. It holds settings and no parameters.

    A target is a distribution of the return: atoms ``[*B, K]`` with weights ``[*B, K]`` that sum to 1. The loss moves
    the atoms (:math:`r + \\gamma z`), the weights stay.
    """

    size: int

    def mean(self, out: Tensor) -> Tensor:
        """The critics' values: ``[*B, critics, size] -> [*B, critics]``."""
        ...

    def pool(self, out: Tensor) -> tuple[Tensor, Tensor]:
        """The target distribution of several critics, ``[*B, critics, size] -> ([*B, K], [*B, K])``."""
        ...

    def loss(self, out: Tensor, atoms: Tensor, weights: Tensor) -> Tensor:
        """Each critic's distance from the target, ``[*B, critics, size], [*B, K], [*B, K] -> [*B, critics]``."""
        ...
