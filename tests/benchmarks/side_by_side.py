"""Frames per second of one SAC run on HalfCheetah-v5, and of two at once, as `pgkit run sac` does it without a flag.

    python tests/benchmarks/side_by_side.py

Each round is one run alone and two at once. A run's figure is the median of its rows of `metrics.csv` after the first
updates. OpenMP's own way of waiting, with two threads: `OMP_WAIT_POLICY=active ... --threads 2`.
"""

import csv
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import contest
import tyro

FIRST = 1_500  # frames before which a row does not count


@dataclass
class Options:
    """One SAC run, and two at once."""

    frames: int = 4_000
    """Frames of each run, of which 1,000 are random."""
    rounds: int = 2
    """Times that both are measured, in alternation."""
    threads: int | None = None
    """Threads of each run; left out, as the recipe chooses."""
    json: str | None = None
    """Write settings, versions and every figure to this file."""


def start(folder: Path, seed: int, options: Options) -> subprocess.Popen[bytes]:
    """A training run in a process of its own."""
    flags = {"--env-id": "HalfCheetah-v5", "--seed": seed, "--total-frames": options.frames, "--eval-every": 0}
    flags |= {"--eval-episodes": 1, "--log-every": 100, "--compile": "on", "--run-dir": folder}
    if options.threads is not None:
        flags["--threads"] = options.threads
    words = [str(word) for pair in flags.items() for word in pair]
    return subprocess.Popen([sys.executable, "-m", "pgkit", "run", "sac", *words], stdout=subprocess.DEVNULL)


def speeds(folder: Path, count: int, options: Options) -> list[float]:
    """Frames/s of so many runs at once."""
    runs = {folder / str(seed): start(folder / str(seed), seed, options) for seed in range(1, count + 1)}
    if any([run.wait() for run in runs.values()]):
        sys.exit("error: a run failed; see above")
    return [speed(where) for where in runs]


def speed(run_dir: Path) -> float:
    """The median of a run's frames/s once it updates."""
    with (run_dir / "metrics.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if int(row["frames"]) > FIRST and row["time/fps"]]
    return median(float(row["time/fps"]) for row in rows)


def main(options: Options) -> None:
    """Prints the table."""
    alone: list[float] = []
    both: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        for index in range(options.rounds):
            for count, found in ((1, alone), (2, both)):
                found += speeds(Path(folder) / f"{index}-{count}", count, options)
                print(f"round {index + 1}, {count} at once: {found[-count:]}", file=sys.stderr, flush=True)
    kept = min(both) / median(alone)
    print(f"{contest.machine()['text']}; waiting threads {os.environ.get('OMP_WAIT_POLICY', 'as pgkit run sets it')}\n")
    print("| runs | frames/s each | share of one alone |\n|---|---|---|")
    print(f"| one | {median(alone):.0f} | 100% |")
    print(f"| two at once | {min(both):.0f} to {max(both):.0f} | at least {kept:.0%} |")
    contest.write(options.json, {"alone": alone, "both": both, "machine": contest.machine()})


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
