"""The DDPG recipe as a user runs it."""

import json

import pytest

from tests.recipes.test_ppo import pgkit, rows

SMALL = ["--batch-size", 32, "--hidden", 16, "--threads", 1, "--compile", "off", "--eval-episodes", 1]


def train(run_dir, *argv, frames=600):
    flags = ["--env-id", "Pendulum-v1", "--eval-every", 300, "--random-frames", 100, "--log-every", 50]
    return pgkit("run", "ddpg", *flags, *SMALL, "--total-frames", frames, "--run-dir", run_dir, *argv)


def test_resumed_with_its_buffer_it_equals_the_straight_run_noise_included(tmp_path):
    train(tmp_path / "straight", "--save-buffer", "--noise", "ou")
    train(tmp_path / "resumed", "--save-buffer", "--noise", "ou", frames=300)
    pgkit("run", "ddpg", "--resume", tmp_path / "resumed", "--total-frames", 600)
    assert rows(tmp_path / "straight") == rows(tmp_path / "resumed")
    assert rows(tmp_path / "straight")[-1]["train/loss_value"]


@pytest.mark.parametrize(
    "flags",
    [
        ("--env-id", "Hopper-v5", "--num-envs", 2, "--steps", 5, "--workers", 2, "--noise", "ou"),
        ("--env-id", "dm_control/cartpole-swingup-v0", "--action-repeat", 4, "--n-step", 3, "--replay", "prioritized"),
    ],
)
def test_runs_for_a_few_hundred_frames(tmp_path, flags):
    train(tmp_path / "run", *flags, frames=300)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"] >= 300


@pytest.mark.slow
def test_learns_pendulum(tmp_path):
    pgkit("run", "ddpg", "--env-id", "Pendulum-v1", "--seed", 11, "--run-dir", tmp_path / "run")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["eval/mean_reward"] >= -200
