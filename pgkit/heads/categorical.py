"""Probabilities of bins between a least and a largest return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgkit.errors import UserError
from pgkit.functional import categorical_mean, categorical_projection, cross_entropy, hl_gauss


@dataclass(frozen=True)
class Bins:
    """The expected return, learnt as a classification; the target is the least of the critics' means.

    Farebrother et al., 2024 (https://arxiv.org/abs/2403.03950). Returns beyond the range count as its ends.

    Args:
        low, high: range of the (discounted) returns; the critics begin at its middle.
        size: bins of each critic.
        project: ``(value [*B], support [bins]) -> probabilities [*B, bins]``:
            :func:`pgkit.functional.hl_gauss` or :func:`pgkit.functional.two_hot`.
    """

    low: float
    high: float
    size: int = 101
    project: Callable[[Tensor, Tensor], Tensor] = hl_gauss

    def __post_init__(self) -> None:
        _check(self.low, self.high, self.size)

    def mean(self, out: Tensor) -> Tensor:
        """``[*B, critics, size] -> [*B, critics]``."""
        return categorical_mean(out, _support(self, out))

    def pool(self, out: Tensor) -> tuple[Tensor, Tensor]:
        """One atom: the least of the critics' means."""
        least = self.mean(out).amin(-1, keepdim=True)
        return least, torch.ones_like(least)

    def loss(self, out: Tensor, atoms: Tensor, weights: Tensor) -> Tensor:
        """Cross-entropy of each critic to the one atom's bins."""
        target = self.project(atoms.squeeze(-1), _support(self, out))
        return cross_entropy(out, target.unsqueeze(-2).expand_as(out))


@dataclass(frozen=True)
class Categorical:
    """The whole distribution of the return on fixed atoms; the target is that of the critic whose mean is the least.

    Bellemare et al., 2017 (https://arxiv.org/abs/1707.06887). Atoms moved beyond the range count as its ends.

    Args:
        low, high: range of the (discounted) returns; the critics begin at its middle.
        size: atoms of each critic.
    """

    low: float
    high: float
    size: int = 101

    def __post_init__(self) -> None:
        _check(self.low, self.high, self.size)

    def mean(self, out: Tensor) -> Tensor:
        """``[*B, critics, size] -> [*B, critics]``."""
        return categorical_mean(out, _support(self, out))

    def pool(self, out: Tensor) -> tuple[Tensor, Tensor]:
        """The support, with the probabilities of the critic whose mean is the least."""
        which = self.mean(out).argmin(-1)[..., None, None].expand(*out.shape[:-2], 1, out.shape[-1])
        weights = out.gather(-2, which).squeeze(-2).softmax(-1)
        return _support(self, out).expand_as(weights), weights

    def loss(self, out: Tensor, atoms: Tensor, weights: Tensor) -> Tensor:
        """Cross-entropy of each critic to the atoms, projected back on the support."""
        target = categorical_projection(atoms, weights, _support(self, out))
        return cross_entropy(out, target.unsqueeze(-2).expand_as(out))


def _support(head: Bins | Categorical, out: Tensor) -> Tensor:
    return torch.linspace(head.low, head.high, head.size, dtype=out.dtype, device=out.device)


def _check(low: float, high: float, size: int) -> None:
    if not (low < high and size > 1):
        raise UserError(f"{size} bins from {low} to {high}: give at least 2, from a lower to a higher return")
