"""What stops a run from outside: Ctrl-C, SIGTERM, SIGHUP; and exits from within that would look like success."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

from pgkit.collectors.serving import STOPS
from pgkit.errors import interrupt_behind


class Signals:
    """Hears the signals that stop a run.

    The first one is noted: the run ends where what it trained is whole. Where :attr:`at_once` is set, in a start or an
    evaluation, it interrupts there. A second Ctrl-C interrupts anywhere. A second SIGTERM or SIGHUP changes nothing:
    ``timeout`` sends two, and a scheduler that loses patience kills.

    Args:
        say: shows a line.

    Attributes:
        asked: a signal has come.
        forced: a second Ctrl-C has come: whatever is raised after it is an interrupt.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.asked = self.forced = False
        self.at_once = True
        self._say = say
        self._handlers: dict[signal.Signals, Any] = {}
        self._exit = os._exit

    def listen(self) -> None:
        """Hears the signals from now on, in the main thread; one that is ignored, as by ``nohup``, stays ignored."""
        if threading.current_thread() is threading.main_thread():
            heard = [s for s in STOPS if s.name == "SIGINT" or signal.getsignal(s) != signal.SIG_IGN]
            self._handlers = {s: signal.signal(s, self._hear) for s in heard}
        self._exit, pid = os._exit, os.getpid()

        def leave(code: int = 0) -> None:  # of an environment, mid-training; a forked process may leave
            if os.getpid() != pid:
                self._exit(code)
            raise SystemExit(code)

        os._exit = leave

    def restore(self) -> None:
        """As before :meth:`listen`."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        os._exit = self._exit

    def broke_off(self, error: BaseException | None) -> bool:
        """Whether an error is an interrupt, or comes of one."""
        return self.forced or interrupt_behind(error) is not None

    def _hear(self, number: int, frame: FrameType | None) -> None:
        again, self.asked = self.asked, True
        if again and number != signal.SIGINT:
            return
        self.forced |= again
        if again or self.at_once:
            raise KeyboardInterrupt
        with contextlib.suppress(RuntimeError):  # the signal came amid a print
            self._say("stopping after this update; press Ctrl-C again to stop at once")
