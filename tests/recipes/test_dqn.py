"""The DQN and Rainbow recipes as a user runs them."""

import json

import pytest

from tests.recipes.test_ppo import pgkit, rows


def train(recipe, run_dir, *argv, frames=400):
    flags = ["--env-id", "CartPole-v1", "--eval-every", 200, "--eval-episodes", 1, "--random-frames", 100]
    small = ["--batch-size", 32, "--hidden", 16, 16, "--compile", "off", "--log-every", 100]
    return pgkit("run", recipe, *flags, *small, "--total-frames", frames, "--run-dir", run_dir, *argv)


@pytest.mark.parametrize("recipe", ["dqn", "rainbow"])
def test_resumed_with_its_buffer_it_equals_the_straight_run(recipe, tmp_path):
    # by itself rainbow's exponent rises over the whole run, and the first half is shorter
    flags = ["--save-buffer", *(["--priority-beta", 1.0] if recipe == "rainbow" else [])]
    train(recipe, tmp_path / "straight", *flags)
    train(recipe, tmp_path / "resumed", *flags, frames=200)
    pgkit("run", recipe, "--resume", tmp_path / "resumed", "--total-frames", 400)
    straight, resumed = rows(tmp_path / "straight"), rows(tmp_path / "resumed")
    assert straight == resumed and straight[-1]["train/loss"]


def test_epsilon_falls_and_is_in_the_checkpoint(tmp_path):
    # a row has the mean of its 100 frames, 25 updates: of the last, eps falls from 1 - 0.95 * 304 / 800 to
    # 1 - 0.95 * 400 / 800, whose middle is at frame 352
    train("dqn", tmp_path / "run", "--epsilon-frames", 800)
    assert float(rows(tmp_path / "run")[-1]["train/epsilon"]) == pytest.approx(1 - 0.95 * 352 / 800, abs=1e-4)
    pgkit("run", "dqn", "--resume", tmp_path / "run", "--total-frames", 600)
    assert float(rows(tmp_path / "run")[-1]["train/epsilon"]) == pytest.approx(1 - 0.95 * 552 / 800, abs=1e-4)


@pytest.mark.parametrize(
    "flags", [("--no-double", "--n-step", 3), ("--replay", "prioritized", "--loss-function", "l2")]
)
def test_runs_for_a_few_hundred_frames(flags, tmp_path):
    train("dqn", tmp_path / "run", *flags)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"] >= 400


@pytest.mark.parametrize("recipe", ["dqn", "rainbow"])
def test_a_continuous_action_is_refused_in_one_line(recipe, tmp_path):
    done = pgkit("run", recipe, "--env-id", "Pendulum-v1", "--run-dir", tmp_path / "run", ok=False)
    assert done.returncode == 2 and f"{recipe} needs one discrete action" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["dqn", "rainbow"])
def test_learns_cartpole(recipe, tmp_path):
    pgkit("run", recipe, "--env-id", "CartPole-v1", "--seed", 1, "--run-dir", tmp_path / "run")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["best/mean_reward"] >= 475
