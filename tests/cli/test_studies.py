"""Experiments, reports and searches from the command line, with runs that take seconds."""

import csv
import dataclasses
import typing

import pytest

from pgkit.cli import recipes, studies
from pgkit.cli.main import main
from pgkit.errors import UserError
from pgkit.run import experiment, tune
from pgkit.run.args import check, of_type

SHORT = ["--total-frames", "256", "--steps", "16", "--eval-episodes", "1", "--compile", "off"]


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_an_experiment_makes_a_table_skips_what_is_done_and_reports(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["experiment", "ppo", "--envs", "CartPole-v1", "--seeds", "1-2", "--jobs", "2", "--out", "ppo.csv"]
    main([*command, *SHORT])
    table = rows("ppo.csv")
    assert tuple(table[0]) == experiment.COLUMNS and [row["seed"] for row in table] == ["1", "2"]
    assert all(row["frames"] == "256" and float(row["eval_mean"]) > 0 and "torch=" in row["versions"] for row in table)
    assert [row["frames"] for row in rows("ppo-curves.csv")] == ["256", "256"]
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("runs/**/summary.json")}
    main([*command, *SHORT])
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("runs/**/summary.json")} == before
    assert rows("ppo.csv") == table
    capsys.readouterr()
    main(["report", "ppo.csv", "-o", "report.md"])
    assert "| CartPole-v1 | ppo |" in capsys.readouterr().out
    assert (tmp_path / "report-curves.png").stat().st_size > 1_000


def test_a_failed_run_is_named_and_the_others_go_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["experiment", "ppo", "--envs", "NoSuchEnv-v1", "CartPole-v1", "--seeds", "1", "--dir", "here", *SHORT])
    out = capsys.readouterr()
    assert end.value.code == 2 and "NoSuchEnv-v1 seed 1" in out.err
    assert "FAILED, exit 2: error: unknown environment id 'NoSuchEnv-v1'" in out.out
    assert [row["env"] for row in rows("here/results.csv")] == ["CartPole-v1"]


def test_runs_with_other_flags_have_other_directories(tmp_path):
    def directories(*flags):
        return [cell.directory for cell in experiment.cells("ppo", ["dm_control/x-v0"], [1, 2], flags, tmp_path)]

    plain, other = directories(), directories("--lmbda", "0.9")
    assert [path.name for path in plain] == ["dm_control-x-v0__1", "dm_control-x-v0__2"]
    assert [path.name for path in other] == ["dm_control-x-v0__lmbda-0.9__1", "dm_control-x-v0__lmbda-0.9__2"]
    long = [directories("--env.some_long_keyword_of_it", "a" * 60 + end)[0].name for end in "bc"]
    assert long[0] != long[1] and max(map(len, long)) < 100


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--envs", "CartPole-v1", "--seeds", "x"], "--seeds x: give numbers and ranges"),
        (["--envs", "CartPole-v1", "CartPole-v1"], "environment CartPole-v1 is given twice"),
        (["--envs", "CartPole-v1", "--seed=3"], "--seed: the experiment sets it"),
        (["--envs", "CartPole-v1", "--jobs", "0"], "--jobs: 0 is not a positive number"),
    ],
)
def test_words_that_make_no_experiment(words, message, capsys):
    with pytest.raises(SystemExit):
        main(["experiment", "ppo", *words])
    assert message in capsys.readouterr().err


def test_damaged_tables_are_named(tmp_path, capsys):
    table = tmp_path / "t.csv"
    header = ",".join(experiment.COLUMNS)
    for text, message in (
        ("", "has no column 'recipe'"),
        (f"{header}\n", "has no rows"),
        (f"{header}\nppo,x,,1,10\n", "line 2"),
        (f"{header}\nppo,x,,1,10,high,1,2,torch=2\n", "no number"),
    ):
        table.write_text(text)
        with pytest.raises(SystemExit):
            main(["report", str(table), "-o", str(tmp_path / "r.md")])
        assert message in capsys.readouterr().err


def test_a_search_finds_the_better_setting_and_goes_on(tmp_path, monkeypatch):
    pytest.importorskip("optuna")
    scores = {"0.5": 3.0, "0.9": 7.0}

    def play(cell):
        cell.directory.mkdir(parents=True)
        (cell.directory / "summary.json").write_text(f'{{"eval/mean_reward": {scores[cell.flags[-1]]}}}')
        yield scores[cell.flags[-1]]

    monkeypatch.setattr(tune, "_evaluations", play)
    for trials in (6, 1):
        best, score = tune.tune("ppo", {"lmbda": [0.5, 0.9]}, "X-v1", trials=trials, seeds=(101,), folder=tmp_path)
        assert (best, score) == ({"lmbda": 0.9}, 7.0)
    assert len(list(tmp_path.glob("trial[0-9]*"))) == 7


def test_settings_as_flags():
    assert tune.as_flags({"hidden": (64, 32), "anneal": True, "normalize_obs": False, "gamma": 0.9}) == (
        "--hidden", "64", "32", "--anneal", "--no-normalize-obs", "--gamma", "0.9",
    )  # fmt: skip
    with pytest.raises(UserError, match="no search space"):
        tune.tune("ppo", {}, "X-v1", trials=1, folder=None)


@pytest.mark.parametrize("recipe", [name for name in recipes.names() if name != "grpo"])  # grpo trains on no env id
def test_a_recipe_s_search_space_is_made_of_its_settings(recipe):
    space = studies.search_space(recipe)
    args = recipes.load(recipes.find(recipe)).Args
    assert len(space) >= 4
    for name, values in space.items():
        hint = typing.get_type_hints(args)[name]
        for value in values if isinstance(values, list) else values[:2]:
            check(dataclasses.replace(args(), **{name: of_type(value, hint)}))
        default = getattr(args(), name)
        numbers = [x for x in values if not isinstance(x, str)]
        assert default in values or min(numbers) <= default <= max(numbers), (
            f"{name}: the default {default} is outside {values}"
        )
