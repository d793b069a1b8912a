"""The seam between a critic's network and the loss that trains it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor

from pgkit.heads.returns import Returns


@runtime_checkable
class Head(Protocol):
    """The meaning of a critic's ``size`` outputs. It holds settings and no parameters."""

    size: int

    def mean(self, out: Tensor) -> Tensor:
        """The critics' values: ``[*B, critics, size] -> [*B, critics]``."""
        ...

    def returns(self, out: Tensor) -> Returns:
        """The return that one critic predicts: ``[*B, size] -> [*B]``."""
        ...

    def least(self, out: Tensor) -> Returns:
        """The cautious return of several critics: ``[*B, critics, size] -> [*B]``."""
        ...

    def loss(self, out: Tensor, target: Returns) -> Tensor:
        """Each critic's distance from the target, ``[*B, critics, size], [*B] -> [*B, critics]``."""
        ...
