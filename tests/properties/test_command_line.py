"""Properties of the command line: whatever is typed, settings come out or one line does."""

import contextlib
import dataclasses
import io
import json
import os
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pgkit.cli import recipes
from pgkit.cli.main import main
from pgkit.errors import UserError
from pgkit.run import config, experiment
from pgkit.run.args import RunArgs, check, of_type
from pgkit.run.settings import parse

RECIPES = ("ppo", "sac", "dqn", "grpo", "mappo")


@cache
def args_class(recipe: str) -> Any:
    return recipes.load(recipes.find(recipe)).Args


@cache
def flags() -> list[str]:
    return sorted({f"--{f.name.replace('_', '-')}" for name in RECIPES for f in dataclasses.fields(args_class(name))})


words = st.one_of(
    st.deferred(lambda: st.sampled_from(flags())),
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(["True", "none", "auto", "--help", "--env.x", "--env.x=[", "--", "-", "=", "--no-anneal", "1e5"]),
    st.text(max_size=6),
)


@settings(max_examples=120)
@given(st.sampled_from(RECIPES), st.lists(words, max_size=5))
def test_flags_give_settings_or_one_line(recipe: str, argv: list[str]):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            args = parse(args_class(recipe), {}, argv)
            check(args)
        except UserError as error:
            assert "\n" not in str(error)
        except SystemExit as end:
            assert not end.code  # --help
        else:
            assert isinstance(args, RunArgs)


@settings(max_examples=40)
@given(
    st.integers(0, 2**40), st.floats(0, 1), st.lists(st.integers(1, 999), min_size=1, max_size=4), st.booleans(),
    st.sampled_from(["none", "gru"]), st.none() | st.floats(0, 9),
)  # fmt: skip
def test_settings_come_back_from_flags_and_from_json(
    seed: int, gamma: float, hidden: list[int], anneal: bool, recurrent: str, kl: float | None
):
    kind = args_class("ppo")
    args = kind(seed=seed, gamma=gamma, hidden=tuple(hidden), anneal=anneal, recurrent=recurrent, target_kl=kl)
    argv = [f"--seed={seed}", f"--gamma={gamma}", "--hidden", *map(str, hidden), f"--{'' if anneal else 'no-'}anneal"]
    argv += [f"--recurrent={recurrent}", f"--target-kl={kl}"]
    with contextlib.redirect_stdout(io.StringIO()):
        assert parse(kind, {}, argv) == args
    with tempfile.TemporaryDirectory() as folder:
        config.write_json(Path(folder) / "x.json", dataclasses.asdict(args) | {"id": "x"})
        saved = config.read_json(Path(folder) / "x.json")
    hints = get_type_hints(kind, include_extras=True)
    for name, value in vars(args).items():
        assert of_type(saved[name], hints[name]) == value


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda x: st.lists(x, max_size=3) | st.dictionaries(st.text(max_size=5), x, max_size=3),
    max_leaves=6,
)


@settings(max_examples=60)
@given(st.dictionaries(st.sampled_from(["recipe", "settings", "id", "file", "command", "sha256", "x"]), plain) | plain)
def test_any_json_is_a_config_or_one_line(content: Any):
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "config.json").write_text(json.dumps(content))
        try:
            config.saved_args(args_class("ppo"), Path(folder))
        except UserError as error:
            assert "\n" not in str(error)


@given(st.text(alphabet="0123456789-, x", max_size=12))
def test_seeds_are_numbers_or_one_line(text: str):
    try:
        assert all(isinstance(seed, int) for seed in experiment.seeds(text))
    except UserError as error:
        assert "--seeds" in str(error) and "\n" not in str(error)


@contextlib.contextmanager
def working_in(folder: str) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


COMMANDS = ["eval", "plot", "export", "report", "cp", "tune", "experiment", "nope", ""]
names = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), min_size=1, max_size=300)


@settings(max_examples=60)
@given(
    st.sampled_from(["eval", "plot", "export", "report", "cp", "tune", "experiment", "nope", ""]),
    st.lists(names, max_size=3),
)
def test_commands_give_a_result_or_one_line(command: str, rest: list[str]):
    out = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, working_in(folder):
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out), pytest.raises(SystemExit) as end:
            main([command, *rest])
        assert end.value.code in (0, 2)
        assert end.value.code == 0 or out.getvalue().count("error:") >= 1
        assert "Traceback" not in out.getvalue() and not any(Path(folder).iterdir())
