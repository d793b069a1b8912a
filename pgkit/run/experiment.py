"""An experiment: one recipe on several environments and seeds, each cell a run of its own; what is done stays done."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pgkit import files
from pgkit.errors import UserError
from pgkit.run.config import read_config, read_json
from pgkit.run.metrics import column, read_csv

COLUMNS = ("recipe", "env", "settings", "seed", "frames", "eval_mean", "minutes", "fps", "versions")
CURVE = ("recipe", "env", "settings", "seed", "frames", "eval_mean", "minutes")
SHOWN = ("pgkit", "torch", "torchrl", "gymnasium", "mujoco")  # versions that a results table names


@dataclass
class Cell:
    """One run of an experiment."""

    recipe: str
    env: str
    seed: int
    flags: tuple[str, ...]
    folder: Path
    process: Any = field(default=None, repr=False)

    @property
    def name(self) -> str:
        return f"{self.env} seed {self.seed}"

    @property
    def directory(self) -> Path:
        """Of its own: other flags, another directory."""
        parts = (self.env, shlex.join(self.flags), str(self.seed))
        return self.folder / "__".join(_file_name(part) for part in parts if part)

    @property
    def done(self) -> bool:
        return (self.directory / "summary.json").is_file()

    @property
    def log(self) -> Path:
        return self.directory.with_name(f"{self.directory.name}.log")

    @property
    def command(self) -> list[str]:
        """How this cell is run by hand; it goes on where it was stopped."""
        where = ["--env-id", self.env, "--seed", str(self.seed), "--run-dir", str(self.directory)]
        return ["pgkit", "run", self.recipe, *where, "--resume-if-possible", *self.flags]

    def start(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", *self.command]
        with self.log.open("a") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)

    def last_words(self) -> str:
        """The last line that a failed run printed."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it printed nothing"


def _file_name(text: str) -> str:
    """Text as part of a file name; long text ends in a digest."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-")
    return plain if len(plain) <= 60 else f"{plain[:50]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def cells(recipe: str, envs: Sequence[str], seeds: Sequence[int], flags: Sequence[str], folder: Path) -> list[Cell]:
    """Every environment with every seed.

    Raises:
        UserError: the flags set what the experiment sets, or an environment or a seed is given twice.
    """
    own = {"--env-id", "--seed", "--run-dir", "--resume", "--resume-if-possible"}
    if taken := own & {flag.partition("=")[0].replace("_", "-") for flag in flags}:
        raise UserError(f"{min(taken)}: the experiment sets it for each run; use --envs, --seeds and --dir")
    for what, given in (("environment", envs), ("seed", seeds)):
        if twice := [x for x in given if list(given).count(x) > 1]:
            raise UserError(f"{what} {twice[0]} is given twice")
    return [Cell(recipe, env, seed, tuple(flags), folder) for env, seed in itertools.product(envs, seeds)]


def run(todo: Sequence[Cell], jobs: int) -> Iterator[tuple[Cell, str | None]]:
    """Runs cells, ``jobs`` at a time; yields each as it ends, with what went wrong or None."""
    waiting, running = [cell for cell in todo if not cell.done], []
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                waiting[0].start()
                running.append(waiting.pop(0))
            for cell in [cell for cell in running if cell.process.poll() is not None]:
                running.remove(cell)
                code = cell.process.returncode
                yield cell, None if cell.done and code == 0 else f"exit {code}: {cell.last_words()} (see {cell.log})"
            time.sleep(0.2)
    finally:
        for cell in running:
            cell.process.terminate()
        for cell in running:
            cell.process.wait()


def row(cell: Cell) -> dict[str, Any]:
    """A finished run's row of the results table: its final evaluation, time and versions."""
    summary, config = read_json(cell.directory / "summary.json"), read_config(cell.directory)
    versions = " ".join(f"{name}={config['versions'][name]}" for name in SHOWN if config["versions"].get(name))
    return {
        **_identity(cell),
        "frames": summary["frames"],
        "eval_mean": round(summary["eval/mean_reward"], 2),
        "minutes": round(summary["wall_s"] / 60, 2),
        "fps": round(summary["time/fps"]),
        "versions": versions,
    }


def curve(cell: Cell) -> list[dict[str, Any]]:
    """A run's evaluations, one row each."""
    rows = [r for r in read_csv(cell.directory / "metrics.csv")[1] if r.get("eval/mean_reward")]
    minutes = [float(r["time/wall_s"]) / 60 for r in rows]
    points = zip(column(rows, "eval/mean_reward"), minutes, strict=True)
    return [
        {**_identity(cell), "frames": int(frames), "eval_mean": round(score, 2), "minutes": round(minute, 2)}
        for (frames, score), minute in points
    ]


def _identity(cell: Cell) -> dict[str, Any]:
    return {"recipe": cell.recipe, "env": cell.env, "settings": shlex.join(cell.flags), "seed": cell.seed}


def write(table: Path, finished: Sequence[Cell]) -> None:
    """Writes the rows of finished cells to ``table`` and their curves beside it; rows of other cells stay."""
    for path, columns, new in (
        (table, COLUMNS, [row(cell) for cell in finished]),
        (table.with_name(f"{table.stem}-curves.csv"), CURVE, [r for cell in finished for r in curve(cell)]),
    ):
        keys = {_key(r) for r in new}
        rows = [r for r in read(path, columns) if _key(r) not in keys] + new
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = io.StringIO(newline="")
        writer = csv.DictWriter(lines, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda r: (*_key(r)[:3], int(r["seed"]), int(r["frames"]))))
        with files.replacing(path) as file:
            file.write(lines.getvalue().encode())


def read(table: Path, columns: Sequence[str] = COLUMNS) -> list[dict[str, str]]:
    """The rows of a results table, none where there is no file.

    Raises:
        UserError: a column is missing, or a row is cut short.
    """
    if not table.is_file():
        return []
    try:
        with table.open(newline="") as file:
            reader = csv.DictReader(file)
            names, rows = reader.fieldnames or (), list(reader)
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{table} cannot be read: {error}") from error
    if missing := [name for name in columns if name not in names]:
        raise UserError(f"{table} is no results table: it has no column '{missing[0]}'")
    for number, r in enumerate(rows, 2):
        if None in r or None in r.values():
            raise UserError(f"{table}, line {number}: {len(columns)} columns are expected; mend or delete the line")
    return rows


def _key(r: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(str(r[name]) for name in ("recipe", "env", "settings", "seed"))


def seeds(text: str) -> list[int]:
    """``1-5`` or ``1,3,7`` as numbers."""
    try:
        parts = [part.partition("-") for part in text.split(",")]
        ranges = [(int(low), int(high or low)) for low, _, high in parts]
    except ValueError:
        raise UserError(f"--seeds {text:.100}: give numbers and ranges such as 1-5 or 1,3,7") from None
    if any(not low <= high < min(low + 10_000, 2**62) for low, high in ranges):
        raise UserError(f"--seeds {text:.100}: give ranges of 1 to 10,000 seeds, each below 2^62")
    return [n for low, high in ranges for n in range(low, high + 1)]


def describe(cell: Cell) -> str:
    """One line about a finished run."""
    summary = json.loads((cell.directory / "summary.json").read_text())
    return f"{cell.name}: {summary['eval/mean_reward']:,.1f} after {summary['wall_s'] / 60:.1f} min"
