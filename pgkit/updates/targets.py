"""Target networks: the delayed parameters of a TorchRL loss follow the trained ones."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn


def target_pairs(loss: nn.Module) -> list[tuple[Tensor, Tensor]]:
    """``(target, source)`` for every tensor of the loss's ``target_*_params`` that has a storage of its own.

    The loss is told that its targets are taken care of, as TorchRL's ``SoftUpdate`` does.
    """
    associated = getattr(loss, "_has_update_associated", {})
    for name in associated:
        associated[name] = True
    pairs = []
    for name, target in loss.named_children():
        if name.startswith("target_") and name.endswith("_params"):
            source = getattr(loss, name.removeprefix("target_"))
            pairs += [(target.get(key), source.get(key)) for key in target.keys(True, True)]
    apart = [(target, source) for target, source in pairs if target.data_ptr() != source.data_ptr()]
    # a compiled graph loses writes to a float64 scalar (a normalizer's count): a scalar buffer is a vector of one here
    scalar = [target.dim() == 0 and not source.requires_grad for target, source in apart]
    return [(t.view(1), s.view(1)) if one else (t, s) for (t, s), one in zip(apart, scalar, strict=True)]


def averaging(loss: nn.Module, tau: float) -> Callable[[], None] | None:
    r"""Moves the targets: :math:`\theta' \leftarrow \theta' + \tau (\theta - \theta')`; buffers are copied.

    None for a loss without delayed parameters.
    """
    pairs = target_pairs(loss)
    # separate_losses holds shared parameters detached: the memory tells what is trained
    trained = {x.data_ptr() for x in loss.parameters() if x.requires_grad}
    moves = [source.data_ptr() in trained for _, source in pairs]

    def average() -> None:
        for (target, source), moving in zip(pairs, moves, strict=True):
            if moving:
                target.lerp_(source.detach(), tau)
            else:
                target.copy_(source)

    return torch.no_grad()(average) if pairs else None
