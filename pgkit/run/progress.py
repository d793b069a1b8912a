"""What a run shows while it trains: a live bar on a terminal, a line an evaluation on a pipe."""

import contextlib
import math
from collections.abc import Mapping

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class Live:
    """Progress towards ``total`` frames, on standard output."""

    def __init__(self, total: int, frames: int = 0):
        columns = (
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("return {task.fields[score]}"),
            TextColumn("{task.fields[fps]} frames/s"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        console = Console()
        self._bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task("", total=total, completed=frames, score="-", fps="-")
        self._bar.start()

    def update(self, frames: int, score: float, fps: float) -> None:
        """Show the latest mean return and speed."""
        with contextlib.suppress(BrokenPipeError):
            self._bar.update(self._task, completed=frames, score=_short(score, ".1f"), fps=_short(fps, ",.0f"))

    def evaluated(self, frames: int, score: float, fps: float, scores: Mapping[str, float]) -> None:
        """Print the line of an evaluation."""
        result = f"{scores['eval/mean_reward']:.1f} ± {scores['eval/std_reward']:.1f}"
        speed = f"{_short(fps, ',.0f')} frames/s"
        self.line(f"frames {frames:>10,}   return {_short(score, '.1f')}   eval {result}   {speed}")

    def line(self, text: str) -> None:
        """Print a line: above the bar on a terminal, as it is on a pipe, whose reader may be gone."""
        with contextlib.suppress(BrokenPipeError):
            if self._bar.disable:
                print(text, flush=True)
            else:
                self._bar.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Ends the bar."""
        with contextlib.suppress(BrokenPipeError):
            self._bar.stop()


def _short(value: float, spec: str) -> str:
    return "-" if math.isnan(value) else format(value, spec)
