"""The one error that is the user's to mend, and the checks of numbers that raise it."""

from __future__ import annotations

import sys
import traceback
from numbers import Integral
from pathlib import Path
from types import TracebackType
from typing import Any

_PGKIT = str(Path(__file__).parent)
_OTHERS = tuple(path for path in sys.path if path.endswith("-packages"))


class UserError(ValueError):
    """Wrong input. The message is one line: what is wrong, where, and what to do.

    The command line prints ``error: <message>`` and exits with 2; every other exception keeps its traceback.
    """


class Diverged(RuntimeError):
    """A run's weights or losses are not finite. The command line prints one line and exits with 3."""


class EnvironmentFailed(RuntimeError):
    """An environment raised, hung, or ended its process. The command line prints one line, and the traceback.

    Args:
        line: which environment, at which step, with which seed, and what happened.
        frames: the traceback as text, since it may come from another process.
    """

    def __init__(self, line: str, frames: str = "") -> None:
        super().__init__(line, frames)
        self.line, self.frames = line, frames

    def __str__(self) -> str:
        return f"{self.line}\n{self.frames}".rstrip()


class EnvironmentHung(EnvironmentFailed):
    """An environment took longer than it may."""


def interrupt_behind(error: BaseException | None) -> KeyboardInterrupt | None:
    """The interrupt that an error comes of: ``with params.to_module(...)`` turns one into a RuntimeError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error


def frames_of(trace: TracebackType | None) -> str:
    """A traceback as text: the user's own frames where the error was raised there or below, or else all."""
    frames = traceback.extract_tb(trace)
    pgkit = [number for number, frame in enumerate(frames) if frame.filename.startswith(_PGKIT)]
    own = [frame for frame in frames if frame.line and not frame.filename.startswith((_PGKIT, *_OTHERS, "<frozen"))]
    raised_there = own and (not pgkit or frames.index(own[-1]) > pgkit[-1])
    return "".join(traceback.format_list(own if raised_there else frames))


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
