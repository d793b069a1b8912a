"""Target networks: the delayed parameters of a TorchRL loss follow the trained ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from pgkit.checks import LossView
from pgkit.errors import UserError, within

Pairs = dict[tuple[str, ...], tuple[Tensor, Tensor]]
Tau = float | Mapping[str, float]


def target_pairs(loss: nn.Module) -> Pairs:
    """``path -> (target, source)`` of every tensor of a target network that has a storage of its own."""
    pairs: Pairs = {}
    for name, target, source in LossView(loss).delayed():
        for key in target.keys(True, True):
            pairs[(name, *((key,) if isinstance(key, str) else key))] = (target.get(key), source.get(key))
    apart = {path: (t, s) for path, (t, s) in pairs.items() if t.data_ptr() != s.data_ptr()}
    # a compiled graph loses writes to a float64 scalar (a normalizer's count): a scalar buffer is a vector of one here
    scalar = {path for path, (target, source) in apart.items() if target.dim() == 0 and not source.requires_grad}
    return {path: (t.view(1), s.view(1)) if path in scalar else (t, s) for path, (t, s) in apart.items()}


def averaging(loss: nn.Module, tau: Tau) -> Callable[[Tensor], None] | None:
    r"""Moves the targets: :math:`\theta' \leftarrow \theta' + \tau (\theta - \theta')`; buffers are copied.

    The function takes a 0-dim bool: where it is False, the targets stay. None for a loss without delayed parameters.

    Args:
        tau: :math:`\tau`, or its values by the names of networks and of modules in them: ``{"qvalue_network": 0.01,
            "encoder": 0.05}``. The innermost name in a parameter's path holds.

    Raises:
        UserError: a target without a rate, a name that no target has, or a rate outside [0, 1].
    """
    moving, statistics = _trained_and_not(loss)
    rates = _rates(moving, tau)

    def average(finite: Tensor) -> None:
        for path, (target, source) in moving.items():
            target.copy_(torch.where(finite, target.lerp(source.detach(), rates[path]), target))
        for target, source in statistics.values():
            target.copy_(source)

    return torch.no_grad()(average) if moving or statistics else None


def copying(loss: nn.Module) -> Callable[[], None]:
    """Copies the buffers of the trained networks (a normalizer's statistics) to the targets."""
    _, statistics = _trained_and_not(loss)

    def copy() -> None:
        for target, source in statistics.values():
            target.copy_(source)

    return torch.no_grad()(copy)


def _rates(moving: Pairs, tau: Tau) -> dict[tuple[str, ...], float]:
    if not isinstance(tau, Mapping):
        within(0, 1, tau=tau)
        return dict.fromkeys(moving, tau)
    within(0, 1, **{f"tau of {name}": rate for name, rate in tau.items()})
    rates = {path: next((tau[part] for part in reversed(path) if part in tau), None) for path in moving}
    known = sorted({path[0] for path in moving})
    if unknown := [name for name in tau if not any(name in path for path in moving)]:
        raise UserError(f"tau names '{unknown[0]}', which is no part of a target: they are {', '.join(known)}")
    if without := [path for path, rate in rates.items() if rate is None]:
        raise UserError(f"tau has no rate for '{'.'.join(without[0])}': name '{without[0][0]}' too")
    return {path: rate for path, rate in rates.items() if rate is not None}


def _trained_and_not(loss: nn.Module) -> tuple[Pairs, Pairs]:
    # separate_losses holds shared parameters detached: the memory tells what is trained
    trained = {x.data_ptr() for x in loss.parameters() if x.requires_grad}
    pairs = target_pairs(loss)
    moving = {path: pair for path, pair in pairs.items() if pair[1].data_ptr() in trained}
    return moving, {path: pair for path, pair in pairs.items() if path not in moving}
