"""Trials: what a function did is undone, and native code must repeat the function on inputs that it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from pgkit.compiled.products import tolerances


def undone(tensors: Iterable[Tensor], function: Callable[[], Any]) -> Any:
    """The function's result; what it did to these tensors and to the random generators is undone."""
    before = [(tensor, tensor.detach().clone()) for tensor in tensors]
    cards = {tensor.device.index for tensor, _ in before if tensor.device.type == "cuda"}
    try:
        with torch.random.fork_rng(devices=cards):
            return function()
    finally:
        with torch.no_grad():
            for tensor, value in before:
                tensor.copy_(value)


def written_by(tensors: Sequence[Tensor], function: Callable[[], Any]) -> list[Tensor]:
    """Those of the tensors that the function writes to; it runs for that, which is undone."""
    versions = [x._version for x in tensors]

    def written() -> list[Tensor]:
        function()
        return [x for x, version in zip(tensors, versions, strict=True) if x._version != version]

    return undone(tensors, written)


def check_repeats(
    native: Callable[..., Sequence[Tensor] | None],
    function: Callable[..., Sequence[Tensor]],
    held: Sequence[Tensor],
    others: Iterable[Sequence[Any]],
) -> None:
    """Runs both on every ``(data, *inputs)`` of ``others``; None from ``native`` leaves these to the function.

    Raises:
        RuntimeError: they differ, by more than rounding, or ``native`` does not write where the function does.
    """

    for arguments in others:
        (expected, changed), (got, kept) = (
            undone(held, partial(_traced, f, held, arguments)) for f in (function, native)
        )
        if got is None:
            continue
        for mine, its in zip(got, expected, strict=True):
            same = mine.shape == its.shape and mine.dtype == its.dtype
            if not (same and torch.isclose(mine, its, **tolerances(), equal_nan=True).all()):
                raise RuntimeError(f"it differs on other inputs: {mine} is not {its}")
        if lost := [tuple(x.shape) for x, one, other in zip(held, changed, kept, strict=True) if one and not other]:
            raise RuntimeError(f"it loses what the function writes to a tensor of shape {lost[0]}")


def _traced(function: Callable[..., Any], held: Sequence[Tensor], arguments: Sequence[Any]) -> tuple[Any, list[bool]]:
    """The function's result, and which of the held tensors it changed."""
    before = [tensor.detach().clone() for tensor in held]
    return function(*arguments), [not torch.equal(x, old) for x, old in zip(held, before, strict=True)]
