"""Wall time, and the part of it that went into training."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Clock:
    """Counts seconds since it was made; ``paused`` blocks and compilation do not count as training."""

    def __init__(self, now: Callable[[], float] = time.perf_counter, already: float = 0.0):
        self._now, self._start = now, now() - already
        self._paused = 0.0
        self._last = (0, 0.0)

    @property
    def wall(self) -> float:
        """Seconds since the start, those of the runs that this one resumes included."""
        return self._now() - self._start

    @contextmanager
    def paused(self) -> Iterator[None]:
        """What happens in this block (evaluation, checkpoints) is left out of the frames per second."""
        begin = self._now()
        try:
            yield
        finally:
            self._paused += self._now() - begin

    def restart(self, frames: int) -> None:
        """Training begins now, with ``frames`` behind it."""
        self._last = (frames, self.wall - self._paused)

    def fps(self, frames: int, compile_seconds: float = 0.0) -> float:
        """Frames per second since the last call; ``compile_seconds`` is this process's total so far."""
        training = self.wall - self._paused - compile_seconds
        (last_frames, last_training), self._last = self._last, (frames, training)
        seconds = training - last_training
        return (frames - last_frames) / seconds if seconds > 0 else float("nan")
