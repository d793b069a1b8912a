"""Returns of finished runs by frames and by minutes, in a table that grows run by run.

    python tests/benchmarks/returns.py add docs/pages/data/critics.csv "layer norm" RUN_DIR ... --speed RUN_DIR
    python tests/benchmarks/returns.py draw docs/pages/data/critics.csv docs/pages/images/critics.png

The first command adds the evaluations of runs that differ in nothing but their seed; ``--speed`` is a short run with
the same settings, alone on the machine: minutes are frames by its speed. The second prints the last returns and draws
the curves. The interquartile mean weighs the middle half of the seeds; its interval is the 95% bootstrap over seeds
(Agarwal et al., 2021, https://arxiv.org/abs/2108.13264).
"""

import csv
import json
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from pgkit.run.directory import read_config
from pgkit.run.metrics import column, read_csv
from pgkit.run.plots import EVALUATION

COLUMNS = ("experiment", "seed", "frames_per_second", "frames", "return")


def read(table: Path) -> list[dict[str, str]]:
    """Rows of a table that :func:`add` wrote; none where there is no such file."""
    if not table.exists():
        return []
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def add(table: Path, experiment: str, runs: tyro.conf.Positional[tuple[Path, ...]] = (), /, speed: Path | None = None):
    """Adds runs of one experiment, in place of those with the same seeds.

    Args:
        table: a CSV file, made where there is none.
        experiment: its name in the figure.
        runs: run directories.
        speed: a short run, for the speed of the whole experiment.
    """
    curves = {
        str(read_config(run)["settings"]["seed"]): column(read_csv(run / "metrics.csv")[1], EVALUATION) for run in runs
    }
    rows = [row for row in read(table) if row["experiment"] != experiment or row["seed"] not in curves]
    for seed, curve in curves.items():
        rows += [
            dict(zip(COLUMNS, (experiment, seed, "", int(frames), round(value, 1)), strict=True))
            for frames, value in curve
        ]
    if speed is not None:
        rate = json.loads((speed / "summary.json").read_text())["time/fps"]
        rows = [row | {"frames_per_second": round(rate, 1)} if row["experiment"] == experiment else row for row in rows]
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def draw(table: Path, figure: Path, /) -> None:
    """Prints the last return of every seed, and draws mean returns against minutes."""
    rows = read(table)
    drawing = Figure(figsize=(7, 5), layout="constrained")
    axes = drawing.subplots()
    print("| experiment | last return of each seed | interquartile mean | its 95% interval | frames/s | minutes |")
    print("|---|---|---|---|---|---|")
    for name in dict.fromkeys(row["experiment"] for row in rows):
        own = [row for row in rows if row["experiment"] == name]
        frames = sorted({int(row["frames"]) for row in own})
        returns = [np.array([float(row["return"]) for row in own if int(row["frames"]) == count]) for count in frames]
        speed, last = float(own[0]["frames_per_second"]), returns[-1]
        minutes, (low, high) = np.array(frames) / speed / 60, interval(last)
        print(
            f"| {name} | {' '.join(f'{value:,.0f}' for value in last)} | {interquartile_mean(last):,.0f} "
            f"| {low:,.0f} to {high:,.0f} | {speed:.0f} | {minutes[-1]:.0f} |"
        )
        axes.plot(minutes, [some.mean() for some in returns], marker="o", label=f"{name} ({len(last)})")
    axes.set(xlabel="minutes", ylabel="return of an evaluation, mean over seeds")
    axes.grid(alpha=0.3)
    drawing.legend(loc="outside lower center", fontsize="small", frameon=False, ncols=2)
    drawing.savefig(figure, dpi=150)


def interquartile_mean(scores: np.ndarray) -> np.ndarray:
    """Mean of the middle half of the last axis; a score on the edge counts with the part of it that lies inside."""
    count = scores.shape[-1]
    edges = np.arange(count + 1) / count
    inside = np.clip(edges[1:], 0.25, 0.75) - np.clip(edges[:-1], 0.25, 0.75)
    return np.sort(scores) @ (inside / 0.5)


def interval(scores: np.ndarray, draws: int = 10_000) -> tuple[float, float]:
    """95% bootstrap interval of the interquartile mean."""
    drawn = np.random.default_rng(0).choice(scores, (draws, len(scores)))
    low, high = np.percentile(interquartile_mean(drawn), [2.5, 97.5])
    return float(low), float(high)


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"add": add, "draw": draw})
