"""A pruned search over a recipe's settings with Optuna; poor trials end early."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from pgkit.errors import UserError
from pgkit.run.config import read_json
from pgkit.run.experiment import Cell
from pgkit.run.metrics import column, read_csv

Space = Mapping[str, Any]
"""Setting to its range: ``(low, high)``, ``(low, high, "log")`` or a list of choices; whole bounds, whole numbers."""


def suggest(trial: Any, name: str, values: Any) -> Any:
    """A value of one setting from an Optuna trial."""
    if isinstance(values, list):
        return trial.suggest_categorical(name, values)
    low, high, *log = values
    if isinstance(low, int) and isinstance(high, int):
        return trial.suggest_int(name, low, high, log=bool(log))
    return trial.suggest_float(name, low, high, log=bool(log))


def as_flags(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Settings as the recipe's flags; a tuple is several values, a bool is ``--x`` or ``--no-x``."""
    flags: list[str] = []
    for name, value in settings.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            flags.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            flags += [f"--{flag}", *map(str, value if isinstance(value, tuple | list) else (value,))]
    return tuple(flags)


def tune(
    recipe: str,
    space: Space,
    env: str,
    *,
    trials: int,
    seeds: tuple[int, ...] = (101, 102),
    flags: tuple[str, ...] = (),
    folder: Path,
) -> tuple[dict[str, Any], float]:
    """The best settings found and their score: the mean over ``seeds`` of the final evaluation.

    Seeds run one after the other. A trial ends early where the median of the trials before it was better at the same
    evaluation (Optuna's median pruner). A search goes on where it stopped: its trials are kept in ``folder``.

    Raises:
        UserError: optuna is missing, the recipe has no search space, or every trial failed.
    """
    try:
        import optuna
    except ImportError as error:
        raise UserError('tuning needs optuna: pip install "pgkit-rl[tune]"') from error
    if not space:
        raise UserError(f"{recipe} has no search space: write SEARCH = {{'learning_rate': (1e-5, 1e-3, 'log')}} in it")
    folder.mkdir(parents=True, exist_ok=True)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        direction="maximize",
        study_name=f"{recipe} {env}",
        storage=f"sqlite:///{folder.resolve() / 'trials.db'}",
        load_if_exists=True,
        sampler=optuna.samplers.TPESampler(seed=seeds[0]),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=5),
    )

    def objective(trial: Any) -> float:
        chosen = {name: suggest(trial, name, values) for name, values in space.items()}
        scores, step = [], 0
        for seed in seeds:
            cell = Cell(recipe, env, seed, (*flags, *as_flags(chosen)), folder / f"trial{trial.number}")
            with closing(_evaluations(cell)) as evaluations:
                for score in evaluations:
                    trial.report(score, step)
                    step += 1
                    if trial.should_prune():
                        raise optuna.TrialPruned
            if not cell.done:
                raise optuna.TrialPruned(cell.last_words())
            scores.append(read_json(cell.directory / "summary.json")["eval/mean_reward"])
        print(f"trial {trial.number}: {sum(scores) / len(scores):,.1f} with {' '.join(as_flags(chosen))}", flush=True)
        return sum(scores) / len(scores)

    study.optimize(objective, n_trials=trials)
    if not any(trial.state.name == "COMPLETE" for trial in study.trials):
        raise UserError(f"no trial of {recipe} ended: the logs in {folder} say why")
    return study.best_params, study.best_value


def _evaluations(cell: Cell) -> Iterator[float]:
    """Runs a cell; its evaluations as they are written."""
    cell.start()
    seen, ended = 0, False
    try:
        while not ended:
            ended = cell.process.poll() is not None
            metrics = cell.directory / "metrics.csv"
            scores = column(read_csv(metrics)[1], "eval/mean_reward") if metrics.exists() else []
            yield from (score for _, score in scores[seen:])
            seen = len(scores)
            time.sleep(0 if ended else 0.5)
    finally:
        cell.process.terminate()
        cell.process.wait()
