"""Target networks: the delayed parameters of a TorchRL loss follow the trained ones."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from pgkit.checks import LossView

Pairs = list[tuple[Tensor, Tensor]]


def target_pairs(loss: nn.Module) -> Pairs:
    """``(target, source)`` for every tensor of the loss's ``target_*_params`` that has a storage of its own."""
    pairs = []
    for target, source in LossView(loss).delayed():
        pairs += [(target.get(key), source.get(key)) for key in target.keys(True, True)]
    apart = [(target, source) for target, source in pairs if target.data_ptr() != source.data_ptr()]
    # a compiled graph loses writes to a float64 scalar (a normalizer's count): a scalar buffer is a vector of one here
    scalar = [target.dim() == 0 and not source.requires_grad for target, source in apart]
    return [(t.view(1), s.view(1)) if one else (t, s) for (t, s), one in zip(apart, scalar, strict=True)]


def averaging(loss: nn.Module, tau: float) -> Callable[[], None] | None:
    r"""Moves the targets: :math:`\theta' \leftarrow \theta' + \tau (\theta - \theta')`; buffers are copied.

    None for a loss without delayed parameters.
    """
    moving, statistics = _trained_and_not(loss)

    def average() -> None:
        for target, source in moving:
            target.lerp_(source.detach(), tau)
        for target, source in statistics:
            target.copy_(source)

    return torch.no_grad()(average) if moving or statistics else None


def copying(loss: nn.Module) -> Callable[[], None]:
    """Copies the buffers of the trained networks (a normalizer's statistics) to the targets."""
    _, statistics = _trained_and_not(loss)

    def copy() -> None:
        for target, source in statistics:
            target.copy_(source)

    return torch.no_grad()(copy)


def _trained_and_not(loss: nn.Module) -> tuple[Pairs, Pairs]:
    # separate_losses holds shared parameters detached: the memory tells what is trained
    trained = {x.data_ptr() for x in loss.parameters() if x.requires_grad}
    moving, statistics = [], []
    for target, source in target_pairs(loss):
        (moving if source.data_ptr() in trained else statistics).append((target, source))
    return moving, statistics
