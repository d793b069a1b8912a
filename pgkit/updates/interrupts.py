"""An interrupt stays an interrupt."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from pgkit.errors import interrupt_behind


def interruptible(call: Callable[..., dict[str, float]]) -> Callable[..., dict[str, float]]:
    """A method of an update that raises ``KeyboardInterrupt`` where one became another error on the way.

    TensorDict's ``with params.to_module(...)``, which losses use, answers an interrupt with a RuntimeError.
    """

    @wraps(call)
    def update(self: Any, *args: Any) -> dict[str, float]:
        try:
            return call(self, *args)
        except Exception as error:
            if (interrupt := interrupt_behind(error)) is not None:
                raise interrupt from None
            raise

    return update
