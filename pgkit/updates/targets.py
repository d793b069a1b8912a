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
            pairs += [(target.get(key).data, source.get(key)) for key in target.keys(True, True)]
    return [(target, source) for target, source in pairs if target.data_ptr() != source.data_ptr()]


def averaging(loss: nn.Module, tau: float) -> Callable[[], None] | None:
    r"""Moves the targets: :math:`\theta' \leftarrow \theta' + \tau (\theta - \theta')`; buffers are copied.

    None for a loss without delayed parameters.
    """
    pairs = target_pairs(loss)

    def average() -> None:
        for target, source in pairs:
            if source.requires_grad:
                target.lerp_(source.detach(), tau)
            else:
                target.copy_(source)

    return torch.no_grad()(average) if pairs else None
