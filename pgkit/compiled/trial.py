"""Trials: what a function did is undone, and native code must repeat the function on inputs that it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor


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

    def traced(run: Callable[..., Any], arguments: Sequence[Any]) -> tuple[Any, list[bool]]:
        before = [tensor.detach().clone() for tensor in held]
        result = run(*arguments)
        return result, [not torch.equal(x, old) for x, old in zip(held, before, strict=True)]

    for arguments in others:
        (expected, written), (got, kept) = (
            undone(held, lambda run=run, arguments=arguments: traced(run, arguments)) for run in (function, native)
        )
        if got is None:
            continue
        for mine, its in zip(got, expected, strict=True):
            if not _close(mine, its):
                raise RuntimeError(f"it differs on other inputs: {mine} is not {its}")
        lost = [tuple(x.shape) for x, one, other in zip(held, written, kept, strict=True) if one and not other]
        if lost:
            raise RuntimeError(f"it loses what the function writes to a tensor of shape {lost[0]}")


def _close(x: Tensor, y: Tensor) -> bool:
    if x.shape != y.shape or x.dtype != y.dtype:
        return False
    return bool(torch.isclose(x, y, rtol=1e-3, atol=1e-4, equal_nan=True).all())
