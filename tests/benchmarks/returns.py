"""Returns of finished runs, experiment by experiment: a table by frames, and a figure by minutes.

    python tests/benchmarks/returns.py --runs RUN_DIR ... --speed RUN_DIR ... --out returns.png

Runs that differ in nothing but their seed are one experiment. The interquartile mean weighs the middle half of the
seeds; its interval is the 95% bootstrap over seeds (Agarwal et al., 2021, https://arxiv.org/abs/2108.13264). Minutes
are frames by the speed of a short run of the same experiment, alone on the machine: `--speed` has one of each.
"""

import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from pgkit.run.directory import read_config
from pgkit.run.metrics import column, read_csv
from pgkit.run.plots import EVALUATION, labels, mean_and_band


@dataclass
class Options:
    """What to compare."""

    runs: list[Path]
    """Finished runs."""
    speed: list[Path]
    """A short run of each experiment."""
    out: Path = Path("returns.png")
    """The figure."""


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


def main(options: Options) -> None:
    """Prints the table, writes the figure."""
    names = labels({path: read_config(path) for path in [*options.runs, *options.speed]})
    speeds = {names[path]: json.loads((path / "summary.json").read_text())["time/fps"] for path in options.speed}
    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.subplots()
    print("| experiment | return of each seed | interquartile mean | 95% | frames/s | minutes |")
    print("|---|---|---|---|---|---|")
    for name, group in itertools.groupby(
        sorted(options.runs, key=lambda path: names[path]), key=lambda path: names[path]
    ):
        curves = [column(read_csv(path / "metrics.csv")[1], EVALUATION) for path in group]
        last = np.array([curve[-1][1] for curve in curves])
        low, high = interval(last)
        minutes = curves[0][-1][0] / speeds[name] / 60
        seeds = " ".join(f"{value:,.0f}" for value in last)
        print(
            f"| {name} | {seeds} | {interquartile_mean(last):,.0f} | {low:,.0f} to {high:,.0f} "
            f"| {speeds[name]:.0f} | {minutes:.0f} |"
        )
        frames, mean, _ = mean_and_band(curves)
        axes.plot(frames / speeds[name] / 60, mean, marker="o", label=f"{name} ({len(last)})")
    axes.set(xlabel="minutes", ylabel="return of an evaluation, mean over seeds")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", fontsize="small", frameon=False)
    figure.savefig(options.out, dpi=150)


if __name__ == "__main__":
    main(tyro.cli(Options))
