"""The FlashSAC recipe as a user runs it."""

import json

import pytest
import torch

from pgkit import run
from tests.recipes.test_ppo import pgkit, rows


def train(run_dir, *argv, frames=600, ok=True):
    flags = ["--env-id", "Pendulum-v1", "--eval-every", 300, "--eval-episodes", 1, "--log-every", 50]
    small = ["--batch-size", 32, "--random-frames", 100, "--actor-width", 8, "--critic-width", 8, "--blocks", 1]
    fast = ["--threads", 1, "--compile", "off", "--updates-per-step", 0.5]
    return pgkit(
        "run", "flash_sac", *flags, *small, *fast, "--total-frames", frames, "--run-dir", run_dir, *argv, ok=ok
    )


def test_resumed_with_its_buffer_it_equals_the_straight_run(tmp_path):
    schedule = ["--save-buffer", "--final-learning-rate", 3e-4]  # one that falls ends with the run's length
    train(tmp_path / "straight", *schedule)
    train(tmp_path / "resumed", *schedule, frames=300)
    pgkit("run", "flash_sac", "--resume", tmp_path / "resumed", "--total-frames", 600)
    assert rows(tmp_path / "straight") == rows(tmp_path / "resumed")
    agent = run.load_agent(tmp_path / "resumed", "latest")
    assert agent.scale.largest > 5 and agent.scale.moments.count == 608
    norms = [
        p.norm(dim=-2) for name, p in agent.critic.named_parameters() if name.endswith("weight") and p.shape[1] > 1
    ]
    assert len(norms) == 4 and all(torch.allclose(x, torch.ones_like(x), atol=1e-5) for x in norms)


def test_two_environments_with_an_action_repeat(tmp_path):
    flags = ["--env-id", "dm_control/cartpole-swingup-v0", "--action-repeat", 4, "--num-envs", 2, "--workers", 2]
    train(tmp_path / "run", *flags, frames=300)
    assert rows(tmp_path / "run")[-1]["train/loss_actor"]


def test_a_discrete_action_is_one_line_and_exit_2(tmp_path):
    done = train(tmp_path / "run", "--env-id", "CartPole-v1", ok=False)
    assert done.returncode == 2 and "categorical_actor" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_learns_pendulum(tmp_path):
    pgkit("run", "flash_sac", "--env-id", "Pendulum-v1", "--seed", 11, "--run-dir", tmp_path / "run")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["eval/mean_reward"] >= -200
