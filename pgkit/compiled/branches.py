"""Branches on whether a mask is empty: a record takes them always, for under an empty mask they change nothing."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from types import CodeType, FrameType
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

_MOST_TIMES = 5_000  # that one line asks: a loop until a mask is empty would never end


class _TakesAll(TorchFunctionMode):
    """``if mask.any():`` is taken and ``if mask.all():`` is not, but for the code in ``exact``."""

    def __init__(self, exact: set[CodeType]) -> None:
        super().__init__()
        self.exact, self.asked = exact, Counter[tuple[CodeType, int]]()
        self._answers: dict[int, tuple[Tensor, bool]] = {}  # with the tensor: an id lives as long as its object

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is Tensor.__bool__ and id(args[0]) in self._answers:
            frame = sys._getframe(1)
            if frame.f_code not in self.exact:
                self._count(frame)
                return self._answers[id(args[0])][1]
        out = func(*args, **(kwargs or {}))
        if func in (torch.any, Tensor.any, torch.all, Tensor.all) and isinstance(out, Tensor):
            self._answers[id(out)] = out, func in (torch.any, Tensor.any)
        return out

    def _count(self, frame: FrameType) -> None:
        place = frame.f_code, frame.f_lineno
        self.asked[place] += 1
        if self.asked[place] > _MOST_TIMES:
            raise RuntimeError(f"'{frame.f_code.co_name}' repeats until a mask is empty")


def every_branch(function: Callable[..., Any], *example: Any) -> Callable[..., Any]:
    """``function``, which takes every branch on ``mask.any()`` and ``not mask.all()`` while it is recorded.

    For code whose branches only save work: ``if hit.any(): x[hit] = 0`` does nothing where nothing is hit. Where that
    is not so, the record differs from the function, and the door finds it on inputs for which the branches differ. A
    branch that raises (an ``assert``) is decided by the values, in all of the code around it: the function runs on the
    example for that.

    Raises:
        RuntimeError: it repeats something until a mask is empty.
    """
    exact: set[CodeType] = set()
    while (code := _raising(function, example, exact)) is not None:
        exact.add(code)

    def call(*arguments: Any) -> Any:
        with _TakesAll(exact) if torch.compiler.is_compiling() else nullcontext():
            return function(*arguments)

    return call


def _raising(function: Callable[..., Any], example: tuple[Any, ...], exact: set[CodeType]) -> CodeType | None:
    """The code that raises where it takes every branch, if there is one."""
    mode = _TakesAll(exact)
    try:
        with mode:
            function(*example)
    except Exception as error:
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        code = None if trace is None else trace.tb_frame.f_code
        if code not in {asked for asked, _ in mode.asked}:
            raise
        return code
    return None
