"""Learning curves of one run or of many, from their ``metrics.csv``."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pgkit import files
from pgkit.errors import UserError
from pgkit.run.args import RunArgs, free_on_resume
from pgkit.run.config import read_config
from pgkit.run.metrics import column, read_csv

Curve = list[tuple[float, float]]
TRAINING, EVALUATION = "rollout/ep_rew_mean", "eval/mean_reward"
_WHICH_RUN = {"env_id", "seed", "run_dir"}  # they tell runs apart, and experiments not


def plot(run_dirs: Sequence[str | Path], out: str | Path, x: Literal["frames", "wall"] = "frames") -> Path:
    """Draw return against frames, or against minutes of training, to ``out``; returns the file that was written.

    Its ending says what is written: png, pdf, svg; without one it is ``.png``.

    One panel an env. Runs of the same env, recipe and settings are seeds of one experiment: the line is their mean,
    the band one standard deviation either side. Lines are training returns, dots are evaluations. Experiments of one
    recipe are told apart by the settings in which they differ.
    """
    from matplotlib.figure import Figure

    panels: dict[str, dict[str, list[Path]]] = defaultdict(dict)
    configs = {run_dir: read_config(run_dir) for run_dir in map(Path, run_dirs)}
    for run_dir, label in labels(configs).items():
        if not (run_dir / "metrics.csv").is_file():
            raise UserError(f"{run_dir} has no metrics.csv: nothing was logged there yet")
        panels[configs[run_dir]["settings"].get("env_id", "?")].setdefault(label, []).append(run_dir)
    figure = Figure(figsize=(6.4 * len(panels), 4.2), layout="constrained")
    for axes, (env_id, experiments) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        for number, (label, members) in enumerate(experiments.items()):
            rows = [read_csv(member / "metrics.csv")[1] for member in members]
            distinct = {configs[member]["settings"].get("seed") for member in members}
            seeds = f" ({len(rows)} {'seeds' if len(distinct) == len(rows) else 'runs'})" if len(rows) > 1 else ""
            colour = f"C{number}"
            _draw(axes, [_curve(r, TRAINING, x) for r in rows], f"{label} training{seeds}", color=colour)
            _draw(
                axes, [_curve(r, EVALUATION, x) for r in rows], f"{label} evaluation{seeds}",
                color=colour, linestyle="--", marker="o", markersize=4, alpha=0.8,
            )  # fmt: skip
        axes.set(title=env_id, xlabel="frames" if x == "frames" else "minutes", ylabel="return of an episode")
        axes.xaxis.set_major_formatter(short_count)
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False)
    out = Path(out)
    try:
        if out.is_dir():
            raise UserError(f"cannot write {out}: it is a directory, give a file name in it")
        out = out if out.suffix else out.with_suffix(".png")
        with files.replacing(out) as file:
            figure.savefig(file, dpi=150, format=out.suffix[1:])
    except (OSError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"cannot write {out}: {error}") from error
    return out


def labels(configs: Mapping[Path, Mapping[str, Any]]) -> dict[Path, str]:
    """Recipe of each run (its file, where that is a copy) and the settings in which it differs from its like."""
    names, recipes = {}, {run_dir: _recipe(config) for run_dir, config in configs.items()}
    for run_dir, config in configs.items():
        settings = config["settings"]
        incidental = _WHICH_RUN.union(map(str, config.get("may_change", free_on_resume(RunArgs))))
        peers = [
            other["settings"]
            for path, other in configs.items()
            if recipes[path] == recipes[run_dir] and other["settings"].get("env_id") == settings.get("env_id")
        ]
        differing = [
            f"{name}={value}"
            for name, value in settings.items()
            if name not in incidental and any(peer.get(name) != value for peer in peers)
        ]
        names[run_dir] = " ".join([recipes[run_dir], *differing])
    return names


def _recipe(config: Mapping[str, Any]) -> str:
    file = Path(config.get("file") or config["recipe"])
    return config["recipe"] if file.stem == config["recipe"] else f"{config['recipe']} ({file.name})"


def _curve(rows: list[dict[str, str]], name: str, x: str) -> Curve:
    """Points of a metric against frames or minutes."""
    if x == "frames":
        return column(rows, name)
    return [(float(row["time/wall_s"]) / 60, float(row[name])) for row in rows if row.get(name)]


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
    if not len(frames):  # nowhere do all have values
        for curve in curves:
            axes.plot(*zip(*curve, strict=True), label=label if curve is curves[0] else None, **style)
        return
    axes.plot(frames, mean, label=label, **({"marker": "o"} if len(frames) == 1 else {}) | style)
    if len(curves) > 1:
        axes.fill_between(frames, mean - deviation, mean + deviation, color=style["color"], alpha=0.15, linewidth=0)


def short_count(value: float, _: int | None) -> str:
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if value >= unit:
            return f"{value / unit:g}{name}"
    return f"{value:g}"
