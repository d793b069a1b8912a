"""The TD3 recipe as a user runs it."""

import json

import pytest

from tests.recipes.test_ppo import pgkit, rows

SMALL = ["--batch-size", 32, "--hidden", 16, "--threads", 1, "--compile", "off", "--eval-episodes", 1]


def train(run_dir, *argv, frames=600):
    flags = ["--env-id", "Pendulum-v1", "--eval-every", 300, "--random-frames", 100, "--log-every", 50]
    return pgkit("run", "td3", *flags, *SMALL, "--total-frames", frames, "--run-dir", run_dir, *argv)


def test_resumed_with_its_buffer_it_equals_the_straight_run(tmp_path):
    train(tmp_path / "straight", "--save-buffer")
    train(tmp_path / "resumed", "--save-buffer", frames=300)
    pgkit("run", "td3", "--resume", tmp_path / "resumed", "--total-frames", 600)
    assert rows(tmp_path / "straight") == rows(tmp_path / "resumed")
    assert rows(tmp_path / "straight")[-1]["train/loss_actor"]


@pytest.mark.parametrize(
    "flags",
    [
        ("--env-id", "Hopper-v5", "--num-envs", 2, "--steps", 5, "--workers", 2),
        ("--env-id", "dm_control/cartpole-swingup-v0", "--action-repeat", 4, "--n-step", 3, "--replay", "prioritized"),
    ],
)
def test_runs_for_a_few_hundred_frames(tmp_path, flags):
    train(tmp_path / "run", *flags, frames=300)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"] >= 300


def test_a_discrete_action_is_one_line_and_exit_2(tmp_path):
    done = pgkit("run", "td3", "--env-id", "CartPole-v1", "--run-dir", tmp_path / "run", ok=False)
    assert done.returncode == 2 and "categorical_actor" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_learns_pendulum(tmp_path):
    pgkit("run", "td3", "--env-id", "Pendulum-v1", "--seed", 11, "--run-dir", tmp_path / "run")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["eval/mean_reward"] >= -200
