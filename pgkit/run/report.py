"""A report on results tables: tables in Markdown, learning curves with bands, profiles, who improves on whom."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from pgkit.errors import UserError
from pgkit.run import experiment, statistics
from pgkit.run.plots import short_count

Group = tuple[str, str]
"""Recipe and settings: what a line of a report is about."""
MARKS = ("<!-- report -->", "<!-- end of report -->")
PUBLISHED = ("recipe", "env", "settings", "score", "source")


def report(
    tables: Sequence[Path],
    out: Path,
    x: str = "frames",
    *,
    published: Path | None = None,
    reach: Sequence[float] = (),
) -> str:
    """Markdown about results tables, written to ``out``; figures go beside it.

    A file that has the two lines of :data:`MARKS` keeps what stands before and after them.

    Args:
        tables: CSV files that ``pgkit experiment`` wrote.
        out: a ``.md`` file. Figures are ``<stem>-curves.png`` and ``<stem>-profiles.png``.
        x: ``frames`` or ``minutes``, the axis of the learning curves.
        published: a CSV file of others' scores, with the columns :data:`PUBLISHED`, to stand beside those of the same
            environment, recipe and settings.
        reach: scores for a table of the frames and minutes that runs take to them.

    Raises:
        UserError: a table is missing, damaged or empty.
    """
    rows = [row for table in tables for row in _present(table)]
    curves = [r for t in tables for r in experiment.read(t.with_name(f"{t.stem}-curves.csv"), experiment.CURVE)]
    scores = by_task(rows)
    parts = markdown(scores, rows, others(published))
    if reach:
        parts.append(time_to_score(curves, reach))
    out.parent.mkdir(parents=True, exist_ok=True)
    if curves:
        _draw_curves(curves, out.with_name(f"{out.stem}-curves.png"), x)
        parts.append(
            f"![Learning curves]({out.stem}-curves.png)\n\n*Interquartile mean over seeds with its 95% interval.*"
        )
    if len({env for env, _ in scores}) > 1 or len({group for _, group in scores}) > 1:
        _draw_profiles(scores, out.with_name(f"{out.stem}-profiles.png"))
        parts.append(
            f"![Performance profiles]({out.stem}-profiles.png)\n\n*Share of runs above a share of the best score.*"
        )
    text = "\n\n".join(parts) + "\n"
    old = out.read_text(encoding="utf-8") if out.is_file() else ""
    if all(mark in old for mark in MARKS):
        text = f"{old.partition(MARKS[0])[0]}{MARKS[0]}\n\n{text}\n{MARKS[1]}{old.partition(MARKS[1])[2]}"
    else:
        text = f"# Results\n\n{text}"
    out.write_text(text, encoding="utf-8")
    return text


def others(published: Path | None) -> dict[tuple[str, Group], str]:
    """What others report, by environment and group."""
    if published is None:
        return {}
    if not published.is_file():
        raise UserError(f"--published {published}: there is no such file")
    found: dict[tuple[str, Group], list[str]] = defaultdict(list)
    for row in experiment.read(published, PUBLISHED):
        found[row["env"], (row["recipe"], row["settings"])].append(f"{row['score']} ({row['source']})")
    return {key: "; ".join(scores) for key, scores in found.items()}


def _present(table: Path) -> list[dict[str, str]]:
    if not (rows := experiment.read(table)):
        raise UserError(f"{table} has no rows: is the path right, and has the experiment finished a run?")
    return rows


def by_task(rows: Sequence[Mapping[str, str]]) -> dict[tuple[str, Group], list[float]]:
    """Final evaluations by environment and group, in the order of the tables.

    Raises:
        UserError: a score is no number.
    """
    scores: dict[tuple[str, Group], list[float]] = defaultdict(list)
    for row in rows:
        try:
            scores[row["env"], (row["recipe"], row["settings"])].append(float(row["eval_mean"]))
        except ValueError:
            raise UserError(
                f"eval_mean of {row['env']}, seed {row['seed']} is '{row['eval_mean']}', no number"
            ) from None
    return dict(scores)


def markdown(
    scores: Mapping[tuple[str, Group], list[float]],
    rows: Sequence[Mapping[str, str]],
    published: Mapping[tuple[str, Group], str],
) -> list[str]:
    """The tables: each environment's interquartile mean, and the probability that one group improves on another."""
    heads = ["env", "recipe", "settings", "seeds", "mean", "interquartile mean (95% interval)", "minutes", "frames/s"]
    heads += ["published"] if published else []
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for (env, (recipe, settings)), values in scores.items():
        own = [r for r in rows if (r["env"], r["recipe"], r["settings"]) == (env, recipe, settings)]
        estimate = statistics.interval(statistics.iqm, [values])
        minutes, fps = (np.median([float(r[name]) for r in own]) for name in ("minutes", "fps"))
        lines.append(
            f"| {env} | {recipe} | {settings and f'`{settings}`'} | {len(values)} | {np.mean(values):,.1f} "
            f"| {estimate} | {minutes:.1f} | {fps:,.0f} |"
            + (f" {published.get((env, (recipe, settings)), '')} |" if published else "")
        )
    return ["\n".join(lines), *_improvements(scores)]


def _improvements(scores: Mapping[tuple[str, Group], list[float]]) -> list[str]:
    groups = list(dict.fromkeys(group for _, group in scores))
    if len(groups) < 2:
        return []
    lines = ["| better | than | environments | probability (95% interval) |", "|---|---|---|---|"]
    for number, first in enumerate(groups):
        for second in groups[number + 1 :]:
            envs = [env for env, group in scores if group == first and (env, second) in scores]
            if envs:
                x, y = ([scores[env, group] for env in envs] for group in (first, second))
                lines.append(f"| {name(first)} | {name(second)} | {len(envs)} | {statistics.improvement(x, y)} |")
    return ["\n".join(lines)] if len(lines) > 2 else []


def time_to_score(curves: Sequence[Mapping[str, str]], reach: Sequence[float]) -> str:
    """A table of the first evaluation at or above each score: medians over seeds of its frames and minutes.

    A seed that never gets there counts as the last of all; where half of them do not, there is no median.
    """
    runs: dict[tuple[str, Group, str], list[tuple[float, float, float]]] = defaultdict(list)
    for r in curves:
        point = (float(r["frames"]), float(r["minutes"]), float(r["eval_mean"]))
        runs[r["env"], (r["recipe"], r["settings"]), r["seed"]].append(point)
    lines = ["| env | recipe | score | seeds that reach it | frames | minutes |", "|---|---|---|---|---|---|"]
    never = (np.inf, np.inf, 0.0)
    for env, group in dict.fromkeys((env, group) for env, group, _ in runs):
        own = [sorted(points) for key, points in runs.items() if key[:2] == (env, group)]
        for score in reach:
            first = [next((point for point in points if point[2] >= score), never) for points in own]
            frames, minutes, _ = np.median(np.array(first), 0)
            shown = f"{frames:,.0f} | {minutes:.1f}" if np.isfinite(frames) else "- | -"
            reached = sum(np.isfinite(point[0]) for point in first)
            lines.append(f"| {env} | {name(group)} | {score:,g} | {reached} of {len(own)} | {shown} |")
    return "\n".join(lines)


def name(group: Group) -> str:
    """Recipe and settings in one phrase."""
    return " ".join(part for part in group if part)


def legend(groups: Iterable[Group]) -> dict[Group, str]:
    """Names for a legend: without the flags that all settings of a recipe share, in lines of 40 characters."""
    flags = {group: re.findall(r"--\S+(?: (?!--)\S+)*", group[1]) for group in groups}
    shared = {
        recipe: set.intersection(*(set(own) for (other, _), own in flags.items() if other == recipe))
        for recipe, _ in flags
    }
    return {
        (recipe, settings): fill(name((recipe, " ".join(flag for flag in own if flag not in shared[recipe]))), 40)
        for (recipe, settings), own in flags.items()
    }


def _draw_curves(rows: Sequence[Mapping[str, str]], out: Path, x: str) -> None:
    from matplotlib.figure import Figure

    runs: dict[str, dict[Group, dict[str, list[tuple[float, float]]]]] = defaultdict(lambda: defaultdict(dict))
    names = legend((r["recipe"], r["settings"]) for r in rows)
    for r in rows:
        group = runs[r["env"]][r["recipe"], r["settings"]]
        group.setdefault(r["seed"], []).append((float(r[x]), float(r["eval_mean"])))
    figure = Figure(figsize=(5.5 * min(len(runs), 3), 3.8 * -(-len(runs) // 3)), layout="constrained")
    panels = figure.subplots(-(-len(runs) // 3), min(len(runs), 3), squeeze=False).flat
    for axes, (env, groups) in zip(panels, runs.items(), strict=False):
        for number, (group, curves) in enumerate(groups.items()):
            _draw_band(axes, list(curves.values()), label=f"{names[group]} ({len(curves)})", color=f"C{number}")
        axes.set(title=env, xlabel=x, ylabel="evaluation return")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize="small")
        if x == "frames":
            axes.xaxis.set_major_formatter(short_count)
    figure.savefig(out, dpi=130)


def _draw_band(axes: Any, curves: Sequence[Sequence[tuple[float, float]]], label: str, color: str) -> None:
    longest = max(curves, key=len)
    end = min(curve[-1][0] for curve in curves)
    at = np.array([point for point, _ in longest if point <= end] or [end])
    values = np.array([np.interp(at, *zip(*curve, strict=True)) for curve in curves])
    bands = [statistics.interval(statistics.iqm, [column], samples=500) for column in values.T]
    axes.plot(at, [band.value for band in bands], label=label, color=color, marker="o", markersize=3)
    axes.fill_between(at, [b.low for b in bands], [b.high for b in bands], color=color, alpha=0.15, linewidth=0)


def _draw_profiles(scores: Mapping[tuple[str, Group], list[float]], out: Path) -> None:
    from matplotlib.figure import Figure

    best: dict[str, float] = defaultdict(float)
    for (env, _), values in scores.items():
        best[env] = max(best[env], *np.abs(values))
    thresholds = np.linspace(0, 1, 101)
    figure = Figure(figsize=(5.5, 3.8), layout="constrained")
    axes = figure.subplots()
    for group, label in legend(group for _, group in scores).items():
        tasks = [np.array(v) / (best[env] or 1.0) for (env, other), v in scores.items() if other == group]
        axes.plot(thresholds, statistics.performance_profile(tasks, thresholds), label=label)
    axes.set(xlabel="score / best score of the environment", ylabel="share of runs above", ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize="small")
    figure.savefig(out, dpi=130)
