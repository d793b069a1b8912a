"""Probabilities of bins between a least and a largest return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgkit.errors import UserError
from pgkit.functional import categorical_mean, categorical_projection, cross_entropy, hl_gauss
from pgkit.heads.returns import Returns


@dataclass(frozen=True)
class _Range:
    """Bins between a least and a largest return."""

    low: float
    high: float
    size: int = 101

    def __post_init__(self) -> None:
        if not (self.low < self.high and self.size > 1):
            raise UserError(
                f"{self.size} bins from {self.low} to {self.high}: give at least 2, from a lower to a higher return"
            )

    def support(self, out: Tensor) -> Tensor:
        """The bins' returns ``[size]``, of the type of ``out``."""
        return torch.linspace(self.low, self.high, self.size, dtype=out.dtype, device=out.device)

    def mean(self, out: Tensor) -> Tensor:
        """``[*B, critics, size] -> [*B, critics]``."""
        return categorical_mean(out, self.support(out))


@dataclass(frozen=True)
class Bins(_Range):
    """The expected return, learnt as a classification; the target is the least of the critics' means.

    Farebrother et al., 2024 (https://arxiv.org/abs/2403.03950). Returns beyond the range count as its ends.

    Args:
        low, high: range of the (discounted) returns; the critics begin at its middle.
        size: bins of each critic.
        project: ``(value [*B], support [bins]) -> probabilities [*B, bins]``:
            :func:`pgkit.functional.hl_gauss` or :func:`pgkit.functional.two_hot`.
    """

    project: Callable[[Tensor, Tensor], Tensor] = hl_gauss

    def returns(self, out: Tensor) -> Returns:
        """The mean, with certainty."""
        return Returns.certain(self.mean(out))

    def least(self, out: Tensor) -> Returns:
        """The least of the critics' means, with certainty."""
        return Returns.certain(self.mean(out).amin(-1))

    def loss(self, out: Tensor, target: Returns) -> Tensor:
        """Cross-entropy of each critic to the bins of the target's mean."""
        return cross_entropy(out, self.project(target.mean, self.support(out)).unsqueeze(-2).expand_as(out))


@dataclass(frozen=True)
class Categorical(_Range):
    """The whole distribution of the return on fixed atoms; the target is that of the critic whose mean is the least.

    Bellemare et al., 2017 (https://arxiv.org/abs/1707.06887). Atoms moved beyond the range count as its ends.

    Args:
        low, high: range of the (discounted) returns; the critics begin at its middle.
        size: atoms of each critic.
    """

    def returns(self, out: Tensor) -> Returns:
        """The support with the critic's probabilities."""
        weights = out.softmax(-1)
        return Returns(self.support(out).expand_as(weights), weights)

    def least(self, out: Tensor) -> Returns:
        """The support with the probabilities of the critic whose mean is the least."""
        which = self.mean(out).argmin(-1)[..., None, None].expand(*out.shape[:-2], 1, out.shape[-1])
        return self.returns(out.gather(-2, which).squeeze(-2))

    def loss(self, out: Tensor, target: Returns) -> Tensor:
        """Cross-entropy of each critic to the target's atoms, projected back on the support."""
        probabilities = categorical_projection(target.atoms, target.weights, self.support(out))
        return cross_entropy(out, probabilities.unsqueeze(-2).expand_as(out))
