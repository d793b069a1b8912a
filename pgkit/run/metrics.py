"""A run's numbers: ``metrics.csv`` with a header that may grow, and the same scalars for TensorBoard."""

import csv
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from tensordict import TensorDictBase

from pgkit.errors import UserError


def read_csv(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """The header and the whole rows of a metrics file, as text: a line that was cut short is left out."""
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        return list(reader.fieldnames or []), [row for row in reader if None not in row and None not in row.values()]


def column(rows: list[dict[str, str]], name: str) -> list[tuple[float, float]]:
    """``(frames, value)`` of every row in which ``name`` has a value."""
    return [(int(row["frames"]), float(row[name])) for row in rows if row.get(name)]


class Metrics:
    """Appends rows to ``run_dir/metrics.csv`` and to TensorBoard.

    ``upto``: keep only the rows of an earlier run with at most so many frames (the frames in the checkpoint).
    """

    def __init__(self, run_dir: Path, upto: int = 0):
        from torch.utils.tensorboard import SummaryWriter

        self.path = run_dir / "metrics.csv"
        self.columns: list[str] = []
        if self.path.exists():
            self.columns, rows = read_csv(self.path)
            self._rewrite([row for row in rows if int(row["frames"]) <= upto])
        self._board = SummaryWriter(str(run_dir), purge_step=upto + 1 if upto else None)

    def write(self, row: Mapping[str, Any]) -> None:
        """Append one row, ``frames`` first. A new name becomes a new column; NaN is left empty."""
        text = {name: _text(value) for name, value in row.items()}
        if new := [name for name in row if name not in self.columns]:
            rows = read_csv(self.path)[1] if self.path.exists() else []
            self.columns += new
            self._rewrite([*rows, text])
        else:
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, self.columns, restval="").writerow(text)
        for name, value in row.items():
            if text[name] and name != "frames":
                self._board.add_scalar(name, value, row["frames"])

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        temporary = self.path.with_suffix(".tmp")
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.columns, restval="")
            writer.writeheader()
            writer.writerows(rows)
        os.replace(temporary, self.path)

    def close(self) -> None:
        self._board.close()


_NO_INFO = {"reward", "done", "terminated", "truncated", "episode_reward", "step_count", "is_init"}


def _text(value: float) -> str:
    return "" if math.isnan(value) else str(value)


def finished_episodes(rollout: TensorDictBase | None) -> list[tuple[float, int]]:
    """``(return, length)`` of the episodes that end in a rollout ``[num_envs, T]``, oldest first.

    A rollout without TorchRL's ``episode_reward`` and ``step_count`` entries has none.
    """
    if rollout is None or not (done := rollout["next", "done"]).any() or "episode_reward" not in rollout["next"].keys():
        return []
    done = done.squeeze(-1).T
    rewards, lengths = (rollout["next", name].squeeze(-1).T[done] for name in ("episode_reward", "step_count"))
    return list(zip(rewards.tolist(), lengths.tolist(), strict=True))


def finished_infos(rollout: TensorDictBase | None) -> dict[str, float]:
    """Means over the episodes that end in a rollout of the single numbers that only ``next`` has: declared ``info``.

    ``is_success`` is logged as ``rollout/success_rate``, any other under its own name.
    """
    if rollout is None or not (done := rollout["next", "done"]).any():
        return {}
    found = {}
    for key in rollout["next"].keys(True, True):
        path = (key,) if isinstance(key, str) else key
        if path[-1] in _NO_INFO or key in rollout.keys(True, True) or rollout[("next", *path)].shape != done.shape:
            continue
        ends = rollout[("next", *path)][done].double()
        if (ends := ends[~ends.isnan()]).numel():
            found["rollout/" + ("success_rate" if path == ("is_success",) else "_".join(path))] = float(ends.mean())
    return found


def averages(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of every name over the rows that have it."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: fmean(_number(name, row[name]) for row in rows if name in row) for name in names}


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, RuntimeError):
        raise UserError(f"the metric '{name}' is a {type(value).__name__} {np.shape(value)}: log one number") from None


def warm(fps: list[float]) -> list[float]:
    """The rows after warm-up: without the first tenth, at least without the first two, if others remain."""
    return fps[min(max(2, len(fps) // 10), len(fps) - 1) :]
