"""The recipes of the on-policy family as a user runs them; PPO's own tests are in test_ppo.py."""

import importlib
import json

import pytest

from pgkit import run
from tests.recipes.test_ppo import rows

RECIPES = {  # with the flags that make a run of a few hundred frames of it
    "a2c": ("--no-anneal",),
    "impala": ("--no-anneal", "--workers", 2, "--max-lag", 2, "--steps", 16),
    "ppo_penalty": ("--steps", 16),
    "ppo_replay": ("--steps", 16),
    "reinforce": ("--no-anneal", "--steps", 16),
    "trpo": ("--steps", 32),
}
DISCRETE, BOX = ("--env-id", "CartPole-v1", "--num-envs", 4), ("--env-id", "Hopper-v5", "--num-envs", 2, "--workers", 2)


def launch(recipe, *argv):
    """As ``pgkit run`` would, in this process."""
    module = importlib.import_module(f"recipes.{recipe}")
    run.launch(module.main, module.Args, module.PRESETS, [str(x) for x in argv])


def train(recipe, run_dir, *argv, frames):
    flags = ["--eval-every", 256, "--eval-episodes", 1, "--total-frames", frames, "--run-dir", run_dir]
    launch(recipe, *flags, *RECIPES[recipe], *argv)


@pytest.mark.parametrize("recipe", RECIPES)
def test_resumed_run_equals_the_straight_one(tmp_path, recipe):
    train(recipe, tmp_path / "straight", *DISCRETE, frames=512)
    train(recipe, tmp_path / "resumed", *DISCRETE, frames=256)
    launch(recipe, "--resume", tmp_path / "resumed", "--total-frames", 512)
    assert rows(tmp_path / "straight") == rows(tmp_path / "resumed")


@pytest.mark.parametrize("recipe", RECIPES)
def test_runs_on_continuous_actions_for_a_few_hundred_frames(tmp_path, recipe):
    train(recipe, tmp_path / "run", *BOX, frames=256)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["frames"] >= 256 and "eval/mean_reward" in summary


@pytest.mark.parametrize(
    ("recipe", "flags"),
    [
        ("impala", ("--correction", "none", "--delay", 2)),
        ("reinforce", ("--no-baseline", "--no-reward-to-go")),
        ("trpo", ("--natural-gradient",)),
    ],
)
def test_runs_with_the_algorithm_s_other_half(tmp_path, recipe, flags):
    train(recipe, tmp_path / "run", *DISCRETE, *flags, frames=256)
    assert float(rows(tmp_path / "run")[-1]["frames"]) >= 256


def test_one_learner_takes_what_processes_deliver_by_themselves(tmp_path, capsys):
    with pytest.raises(SystemExit):
        train("impala", tmp_path / "run", *DISCRETE, "--ray", "--learners", 2, frames=256)
    assert "--learners 2: processes at their own pace feed one learner" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES)
def test_solves_cartpole(tmp_path, recipe):
    launch(recipe, "--env-id", "CartPole-v1", "--seed", 11, "--run-dir", tmp_path / "run")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["eval/mean_reward"] >= 475
