"""``pgkit experiment / report / tune``: many runs, and what they show."""

from __future__ import annotations

import argparse
import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pgkit.cli import recipes
from pgkit.errors import UserError


def add(commands: Any, positive: Callable[[str], int]) -> None:
    """Adds the three commands to the grammar of ``pgkit``."""
    command = commands.add_parser(
        "experiment",
        allow_abbrev=False,
        help="train a recipe on several envs and seeds, and write a results table",
        usage="pgkit experiment RECIPE --envs ENV [ENV ...] --seeds 1-5 [--jobs N] [--out FILE.csv] [RECIPE'S FLAGS]",
    )
    command.add_argument("recipe", help="a name that pgkit ls shows, or a file")
    command.add_argument("--envs", nargs="+", required=True, metavar="ENV", help="environment ids")
    command.add_argument("--seeds", default="1-3", help="such as 1-5 or 1,3,7 (default: 1-3)")
    command.add_argument("--jobs", type=positive, default=1, help="runs at a time, one thread each (default: 1)")
    command.add_argument("--dir", type=Path, help="where the runs go (default: runs/experiments/RECIPE)")
    command.add_argument("--out", type=Path, help="results table, extended where it exists (default: DIR/results.csv)")
    command.set_defaults(command=run_experiment, takes_flags=True)

    command = commands.add_parser("report", help="tables, curves and profiles of results tables")
    command.add_argument("tables", type=Path, nargs="+", metavar="FILE.csv", help="tables that pgkit experiment wrote")
    command.add_argument("-o", "--out", type=Path, default=Path("report.md"), help="(default: report.md)")
    command.add_argument("--x", choices=["frames", "minutes"], default="frames", help="axis of the curves")
    command.add_argument("--published", type=Path, metavar="FILE.csv", help="others' scores, to stand beside")
    command.add_argument("--reach", type=float, nargs="+", default=[], metavar="SCORE", help="show the time to scores")
    command.set_defaults(command=write_report)

    command = commands.add_parser(
        "tune",
        allow_abbrev=False,
        help="search a recipe's settings with Optuna",
        usage="pgkit tune RECIPE --env-id ENV [--trials N] [--seeds 101,102] [RECIPE'S FLAGS]",
    )
    command.add_argument("recipe", help="a name that pgkit ls shows, or a file with a SEARCH space")
    command.add_argument("--env-id", required=True, help="environment id")
    command.add_argument("--trials", type=positive, default=20, help="how many (default: 20)")
    command.add_argument("--seeds", default="101,102", help="seeds that no table uses (default: 101,102)")
    command.add_argument("--dir", type=Path, help="where trials are kept (default: runs/tune/RECIPE-ENV)")
    command.set_defaults(command=run_tune, takes_flags=True)


def run_experiment(args: argparse.Namespace) -> None:
    from pgkit.run import experiment

    recipes.find(args.recipe)
    folder = args.dir or Path("runs/experiments") / Path(args.recipe).stem
    cells = experiment.cells(args.recipe, args.envs, experiment.seeds(args.seeds), args.flags, folder)
    table, failed = args.out or folder / "results.csv", []
    ready = sum(cell.done for cell in cells)
    print(f"{len(cells)} runs in {folder}, {ready} of them done, {args.jobs} at a time", flush=True)
    if ready:
        experiment.write(table, [cell for cell in cells if cell.done])
    for number, (cell, problem) in enumerate(experiment.run(cells, args.jobs), ready + 1):
        result = f"{cell.name}: FAILED, {problem}" if problem else experiment.describe(cell)
        print(f"[{number}/{len(cells)}] {result}", flush=True)
        failed += [cell] * (problem is not None)
        experiment.write(table, [cell] if problem is None else [])
    print(f"results: {table}\n  report    pgkit report {table}")
    if failed:
        names = ", ".join(cell.name for cell in failed)
        raise UserError(f"{len(failed)} of {len(cells)} runs failed ({names}); the same command tries them again")


def write_report(args: argparse.Namespace) -> None:
    from pgkit.run.report import report

    if args.out.suffix != ".md":
        raise UserError(f"--out {args.out}: give a name that ends in .md")
    text = report(args.tables, args.out, args.x, published=args.published, reach=args.reach)
    print(text, end="")
    print(f"wrote {args.out}")


def run_tune(args: argparse.Namespace) -> None:
    from pgkit.run import experiment
    from pgkit.run.tune import as_flags, tune

    folder = args.dir or Path("runs/tune") / f"{Path(args.recipe).stem}-{args.env_id.replace('/', '-')}"
    seeds = tuple(experiment.seeds(args.seeds))
    best, score = tune(
        args.recipe, search_space(args.recipe), args.env_id, trials=args.trials, seeds=seeds, flags=tuple(args.flags),
        folder=folder,
    )  # fmt: skip
    print(f"best: {score:,.1f}\n  pgkit run {args.recipe} --env-id {args.env_id} {' '.join(as_flags(best))}")


def search_space(recipe: str) -> dict[str, Any]:
    """A recipe's ``SEARCH``, read and not run."""
    for node in ast.parse(recipes.find(recipe).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "SEARCH":
            try:
                return ast.literal_eval(node.value)
            except ValueError:
                raise UserError(f"SEARCH of {recipe}: write plain numbers, strings, tuples and lists") from None
    return {}
