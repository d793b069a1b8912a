"""Learning curves of one run or of many, from their ``metrics.csv``."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pgkit.errors import UserError
from pgkit.run.directory import read_config
from pgkit.run.metrics import column, read_csv

Curve = list[tuple[int, float]]
TRAINING, EVALUATION = "rollout/ep_rew_mean", "eval/mean_reward"


def plot(run_dirs: Sequence[str | Path], out: str | Path) -> None:
    """Draw return against frames to ``out`` (png, pdf, svg by its ending).

    One panel an env. Runs of the same env and recipe are seeds of one experiment: the line is their mean, the
    band one standard deviation either side. Lines are training returns, dots are evaluations.
    """
    from matplotlib.figure import Figure

    groups: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for run_dir in map(Path, run_dirs):
        config = read_config(run_dir)
        if not (run_dir / "metrics.csv").is_file():
            raise UserError(f"{run_dir} has no metrics.csv: nothing was logged there yet")
        groups[config["settings"]["env_id"]][config["recipe"]].append(run_dir)
    figure = Figure(figsize=(6.4 * len(groups), 4.2), layout="constrained")
    for axes, (env_id, recipes) in zip(figure.subplots(1, len(groups), squeeze=False)[0], groups.items(), strict=True):
        for number, (recipe, members) in enumerate(recipes.items()):
            rows = [read_csv(member / "metrics.csv")[1] for member in members]
            seeds = f" ({len(rows)} seeds)" if len(rows) > 1 else ""
            colour = f"C{number}"
            _draw(axes, [column(r, TRAINING) for r in rows], f"{recipe} training{seeds}", color=colour)
            _draw(
                axes, [column(r, EVALUATION) for r in rows], f"{recipe} evaluation{seeds}",
                color=colour, linestyle="--", marker="o", markersize=4, alpha=0.8,
            )  # fmt: skip
        axes.set(title=env_id, xlabel="frames", ylabel="return of an episode")
        axes.xaxis.set_major_formatter(_frames)
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False)
    try:
        figure.savefig(out, dpi=150)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot write {out}: {error}") from error


def mean_and_band(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames, mean and standard deviation over curves, each ``[M]``, where all of them have values.

    The curves are read, linearly, at the frames of the one with most points.
    """
    longest = max(curves, key=len)
    start, end = max(curve[0][0] for curve in curves), min(curve[-1][0] for curve in curves)
    frames = np.array([x for x, _ in longest if start <= x <= end])
    values = np.array([np.interp(frames, [x for x, _ in curve], [y for _, y in curve]) for curve in curves])
    return frames, values.mean(axis=0), values.std(axis=0)


def _draw(axes: Any, curves: list[Curve], label: str, **style: Any) -> None:
    curves = [curve for curve in curves if curve]
    if not curves:
        return
    frames, mean, deviation = mean_and_band(curves)
    axes.plot(frames, mean, label=label, **style)
    if len(curves) > 1:
        axes.fill_between(frames, mean - deviation, mean + deviation, color=style["color"], alpha=0.15, linewidth=0)


def _frames(value: float, _: int | None) -> str:
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:g}{name}"
    return f"{value:g}"
