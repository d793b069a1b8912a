"""A run's numbers: ``metrics.csv`` with a header that may grow, and the same scalars for TensorBoard."""

import contextlib
import csv
import hashlib
import io
import math
import os
from collections.abc import Mapping, Sequence
from logging import getLogger
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from pgkit import files
from pgkit.envs.once import warn_once
from pgkit.errors import UserError
from pgkit.run.board import Board

_log = getLogger("pgkit")


def read_csv(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """The header and the whole rows of a metrics file, as text: a line that was cut short is left out.

    Raises:
        UserError: it is no such file, or a value is no number.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, strict=True)
            columns = list(reader.fieldnames or [])
            rows = [row for row in reader if None not in row and None not in row.values()]
        for name in columns:
            column(rows, name)  # numbers, all of them
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise UserError(f"{path} is damaged: {error}") from error
    return columns, rows


def column(rows: list[dict[str, str]], name: str) -> list[tuple[float, float]]:
    """``(frames, value)`` of every row in which ``name`` has a value."""
    return [(int(row["frames"]), float(row[name])) for row in rows if row.get(name)]


def digest(path: Path, upto: int) -> str:
    """The hash of the values in the rows with at most so many frames; columns that came later do not count."""
    rows = read_csv(path)[1] if path.exists() else []
    values = [sorted((k, v) for k, v in row.items() if v) for row in rows if int(row["frames"]) <= upto]
    return hashlib.sha256(repr(values).encode()).hexdigest()


class Metrics:
    """Appends rows to ``run_dir/metrics.csv`` and to TensorBoard; where they cannot be written, they wait.

    Args:
        run_dir: the run directory.
        upto: keep only the rows of an earlier run with at most so many frames (the frames in the checkpoint).
        identity: ends the name of TensorBoard's file, by which the run knows its own.
    """

    def __init__(self, run_dir: Path, upto: int = 0, identity: str = "pgkit") -> None:
        self.path = run_dir / "metrics.csv"
        self.columns: list[str] = []
        self._waiting: list[dict[str, str]] = []
        if self.path.exists():
            self.columns, rows = read_csv(self.path)
            self._rewrite([row for row in rows if int(row["frames"]) <= upto])
        try:
            self._board: Board | None = Board(run_dir, identity, upto)
        except OSError as error:
            files.cannot_write(run_dir, error)

    def write(self, row: Mapping[str, Any]) -> None:
        """Append one row, ``frames`` first. A new name becomes a new column; NaN is left empty."""
        text = {name: _text(value) for name, value in row.items()}
        self._waiting.append(text)
        try:
            self._append()
        except UserError as error:
            _log.warning("%s; the training goes on, and its rows wait", error)
        if self._board is None:
            return
        try:
            for name, value in row.items():
                if text[name] and name != "frames":
                    self._board.add(name, value, row["frames"])
            self._board.flush()
        except OSError as error:
            self._board = None
            _log.warning("TensorBoard's file cannot be written: %s; metrics.csv goes on", error.strerror)

    def _append(self) -> None:
        new = list(dict.fromkeys(name for row in self._waiting for name in row if name not in self.columns))
        if new or not self.path.exists():
            rows = read_csv(self.path)[1] if self.path.exists() else []
            self.columns += new
            self._rewrite([*rows, *self._waiting])
        else:
            lines = io.StringIO(newline="")
            csv.DictWriter(lines, self.columns, restval="").writerows(self._waiting)
            size = self.path.stat().st_size
            try:
                with self.path.open("a", newline="", encoding="utf-8") as file:
                    file.write(lines.getvalue())
            except OSError as error:
                os.truncate(self.path, size)  # no half lines
                files.cannot_write(self.path, error)
        self._waiting = []

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        lines = io.StringIO(newline="")
        writer = csv.DictWriter(lines, self.columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
        with files.replacing(self.path) as file:
            file.write(lines.getvalue().encode())

    def close(self) -> None:
        """Ends TensorBoard's file; a UserError if rows are still waiting that cannot be written."""
        if self._board is not None:
            with contextlib.suppress(OSError):
                self._board.close()
        if self._waiting:
            self._append()


def _text(value: float) -> str:
    return "" if math.isnan(value) else str(value)


_NO_INFO = {"reward", "done", "terminated", "truncated", "episode_reward", "step_count", "is_init"}


def finished_episodes(rollout: TensorDictBase | None) -> list[tuple[float, int]]:
    """``(return, length)`` of the episodes that end in a rollout ``[num_envs, T]``, oldest first.

    Of several agents, the return is their mean. A rollout without TorchRL's ``episode_reward`` and ``step_count``
    entries has none.
    """
    if rollout is None or not (done := rollout["next", "done"]).any():
        return []
    following = rollout["next"]
    totals = [key for key in following.keys(True, True) if "episode_reward" in (key, key[-1])]
    if not totals:
        return []
    done = done.squeeze(-1).T
    returns = torch.cat([following[key].flatten(2) for key in totals], -1)
    rewards = (returns.squeeze(-1) if returns.shape[-1] == 1 else returns.double().mean(-1)).T[done]
    lengths = following["step_count"].squeeze(-1).T[done]
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
        if ends.isnan().all():
            warn_once(f"info '{'.'.join(path)}' was in no step that ended an episode: is that its name?")
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
