"""Decisions that a recorded function takes on tensors' values: what a graph of its operations takes for granted."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import disable_proxy_modes_tracing
from torch.utils._python_dispatch import TorchDispatchMode


class Decisions(TorchDispatchMode):
    """While active, a recorded function may read values: ``if kl > bound``, ``support.max().item()``.

    The recording follows the branch that these values take, so the graph is right for steps in which they come out the
    same; :meth:`hold` is the graph's own test of that.
    """

    def __init__(self) -> None:
        super().__init__()
        self._read: list[Tensor] = []
        self._values: list[bool | int | float] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is not torch.ops.aten._local_scalar_dense.default:
            return func(*args, **(kwargs or {}))
        with disable_proxy_modes_tracing():
            value = func(*args)
        self._read.append(args[0].clone())  # it may change later in the step
        self._values.append(value)
        return value

    def __len__(self) -> int:
        return len(self._values)

    @property
    def numbers(self) -> bool:
        """Whether a number was read, not only yes or no."""
        return any(not isinstance(value, bool) for value in self._values)

    def hold(self) -> Tensor:
        """Whether all values are what they were when recorded: a bool tensor ``[]``."""
        return torch.stack([x == value for x, value in zip(self._read, self._values, strict=True)]).all()
