"""A limit on the time that an environment's step or reset may take."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, cast

from torch import Tensor

from pgkit.errors import EnvironmentHung, UserError
from pgkit.seams import Entries, Simulator, Step


class Overdue(BaseException):
    """A step or a reset takes too long. No ``Exception``: an environment's ``except Exception`` must not catch it."""


def limited(simulator: Simulator, seconds: float | None) -> Simulator:
    """The simulator with a limit on the time of a step, where there is one."""
    return simulator if seconds is None else cast(Any, Limited(simulator, seconds))


class Limited:
    """A :class:`~pgkit.seams.Simulator` whose steps and resets are interrupted after so many seconds.

    The interrupt is SIGALRM's, heard by the main thread whenever Python runs or waits there. Compiled code that never
    returns does not hear it: only another process can end that (:class:`pgkit.collectors.workers.Workers`).

    Args:
        simulator: what it steps.
        seconds: all its environments together may take so long for one step.
    """

    def __init__(self, simulator: Simulator, seconds: float) -> None:
        if not 0 < seconds < 10**6:
            raise UserError(f"env_timeout={seconds}: give a number of seconds above 0")
        if "SIGALRM" not in signal.Signals.__members__:
            raise UserError("env_timeout needs the signal SIGALRM, which this system does not have: leave it out")
        self._simulator, self._seconds = simulator, seconds

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulator, name)

    def reset(self, seed: int | None = None, rows: Tensor | None = None) -> Entries:
        """As the simulator's, or :class:`~pgkit.errors.EnvironmentHung`."""
        with self._alarm():
            return self._simulator.reset(seed, rows)

    def step(self, action: Entries) -> Step:
        """As the simulator's, or :class:`~pgkit.errors.EnvironmentHung`."""
        with self._alarm():
            return self._simulator.step(action)

    @contextmanager
    def _alarm(self) -> Iterator[None]:
        """Raises :class:`Overdue` in a block that takes longer; outside the main thread, nothing happens."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = signal.signal(signal.SIGALRM, self._ring)
        signal.setitimer(signal.ITIMER_REAL, self._seconds)
        try:
            yield
        except Overdue as error:  # outside the environment's own code: the last of them was just in time
            raise EnvironmentHung(f"the environments: {error}") from error
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)

    def _ring(self, number: int, frame: FrameType | None) -> None:
        raise Overdue(f"it takes longer than {self._seconds:g} s (--env-timeout)")
