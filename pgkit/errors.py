"""The one error that is the user's to mend, and the checks of numbers that raise it."""

from __future__ import annotations

from numbers import Integral
from typing import Any


class UserError(ValueError):
    """Wrong input. The message is one line: what is wrong, where, and what to do.

    The command line prints ``error: <message>`` and exits with 2; every other exception keeps its traceback.
    """


class Diverged(RuntimeError):
    """A run's weights or losses are not finite. The command line prints one line and exits with 3."""


def check_whole_number(least: int, **settings: Any) -> None:
    """Raises ``UserError`` for a setting that is no whole number, or below ``least``; None passes."""
    for name, value in settings.items():
        if value is not None and (not isinstance(value, Integral) or value < least):
            raise UserError(f"{name}={value!r}: give a whole number, at least {least}")


def within(low: float, high: float, **settings: Any) -> None:
    """Raises ``UserError`` for a setting that is no number from ``low`` to ``high``; None passes."""
    for name, value in settings.items():
        if value is not None and not low <= float(value) <= high:
            bounds = f"from {low:g} to {high:g}" if high < float("inf") else f"that is at least {low:g}"
            raise UserError(f"{name}={float(value):g}: give a number {bounds}")
