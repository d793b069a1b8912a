"""The slip of ``(B,)`` with ``(B, 1)``, which torch broadcasts to a table ``(B, B)`` without a word."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any

from torch import Tensor
from torch.overrides import TorchFunctionMode

from pgkit.errors import UserError

_ELEMENTWISE = {"add", "radd", "sub", "rsub", "mul", "rmul", "div", "truediv", "rtruediv", "rdiv", "pow", "where"}
_ELEMENTWISE |= {"minimum", "maximum", "l1_loss", "mse_loss", "smooth_l1_loss", "huber_loss"}


class BroadcastError(UserError):
    """A ``(B,)`` and a ``(B, 1)`` became a ``(B, B)``."""


class NoBroadcasts(TorchFunctionMode):
    """Within it, an elementwise operation on a ``(B,)`` and a ``(B, 1)`` raises :class:`BroadcastError`.

    Args:
        name: of whose operations they are.
    """

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        name = getattr(func, "__name__", "").strip("_")
        if name in _ELEMENTWISE:
            shapes = sorted({tuple(x.shape) for x in args if isinstance(x, Tensor)}, key=len)
            rows = shapes[0][0] if shapes and shapes[0] else 0
            # (B,) with (B, 1), and of a group of one agent (B, 1) with (B, 1, 1)
            if len(shapes) == 2 and shapes[1] == (*shapes[0], 1) and rows == prod(shapes[0]) > 1:
                raise BroadcastError(
                    f"{self.name} broadcasts a {shapes[0]} and a {shapes[1]} to {(rows, *shapes[0])}, in '{name}': "
                    "unsqueeze(-1) the first or squeeze(-1) the second (for a table that is meant, unsqueeze(0) the "
                    "first)"
                )
        return func(*args, **(kwargs or {}))
