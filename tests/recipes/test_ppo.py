"""The PPO recipe as a user runs it."""

import csv
import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from types import SimpleNamespace

import pytest

from pgkit.cli.main import main


def pgkit(*argv, ok=True):
    """The command line in this process: one of its own costs five seconds of imports (tests/cli has those)."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    before = sys.argv, [*sys.path], sys.excepthook
    try:
        with redirect_stdout(out), redirect_stderr(err):
            main([*map(str, argv)])
    except SystemExit as exit_:
        code = exit_.code
    finally:
        sys.argv, sys.path[:], sys.excepthook = before
    assert (code == 0) == ok, out.getvalue() + err.getvalue()
    return SimpleNamespace(returncode=code, stdout=out.getvalue(), stderr=err.getvalue())


def rows(run_dir):
    with open(run_dir / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]


def train(run_dir, *argv, frames=1024):
    flags = ["--env-id", "CartPole-v1", "--eval-every", 512, "--eval-episodes", 2]
    return pgkit("run", "ppo", *flags, "--total-frames", frames, "--run-dir", run_dir, *argv)


def test_same_seed_same_metrics_and_another_seed_differs(tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        train(tmp_path / name, "--seed", seed)
    assert rows(tmp_path / "a") == rows(tmp_path / "b") != rows(tmp_path / "c")
    assert len(rows(tmp_path / "a")) == 4


@pytest.mark.parametrize("overlap", ["no-overlap", "overlap"])
def test_resumed_run_equals_the_straight_one(tmp_path, overlap):
    train(tmp_path / "straight", f"--{overlap}", frames=2048)
    train(tmp_path / "resumed", f"--{overlap}", frames=1024)
    pgkit("run", "ppo", "--resume", tmp_path / "resumed", "--total-frames", 2048)
    assert rows(tmp_path / "straight") == rows(tmp_path / "resumed")


@pytest.mark.parametrize(
    "flags",
    [
        ("--env-id", "Pendulum-v1", "--num-envs", 4, "--steps", 64, "--workers", 2),
        ("--env-id", "CartPole-v1", "--recurrent", "gru", "--num-envs", 4, "--steps", 64, "--workers", 2),
        ("--env-id", "Pendulum-v1", "--recurrent", "lstm", "--num-envs", 2, "--steps", 64),
        ("--env-id", "Hopper-v5", "--steps", 32, "--anneal", "--target-kl", 0.01),
        ("--env-id", "dm_control/cartpole-swingup-v0", "--num-envs", 2, "--steps", 128),
        ("--env-id", "CartPole-v1", "--collector", "torchrl", "--normalize-advantage", "off"),
    ],
)
def test_runs_for_a_few_hundred_frames(tmp_path, flags):
    pgkit("run", "ppo", *flags, "--total-frames", 512, "--eval-episodes", 1, "--run-dir", tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["frames"] >= 512 and "eval/mean_reward" in summary
    assert (tmp_path / "run" / "curve.png").stat().st_size > 5_000


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ("--env-id", "CartPol-v1"),
            "unknown environment id 'CartPol-v1'; the nearest names are CartPole-v1",
        ),
        (("--total-frames", 10), "total_frames=10 is less than one rollout"),
        (("--overlap", "--collector", "torchrl"), "TorchRL's Collector waits for the update"),
        (("--ray", "--collector", "torchrl"), "--ray: TorchRL's Collector waits for the update"),
        (("--num-envs", 2, "--workers", 3), "every worker needs at least one environment"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing_behind(tmp_path, flags, message):
    done = pgkit("run", "ppo", "--env-id", "CartPole-v1", *flags, "--run-dir", tmp_path / "run", ok=False)
    assert done.returncode == 2 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("recurrent", "low", "high"), [("gru", 0.95, 1.0), ("lstm", 0.95, 1.0), ("none", -0.6, 0.6)])
def test_only_a_memory_solves_the_maze(tmp_path, recurrent, low, high):
    # without one the expected return is at most 0; of 100 episodes of -1 or 1 the mean deviates by 0.1
    flags = ["--env-id", "pgkit/TMaze-v0", "--recurrent", recurrent, "--eval-episodes", 100]
    pgkit("run", "ppo", *flags, "--run-dir", tmp_path / "run")
    assert low <= json.loads((tmp_path / "run" / "summary.json").read_text())["eval/mean_reward"] <= high


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "frames", "threshold"), [("CartPole-v1", 100_000, 500), ("Pendulum-v1", 200_000, -200)]
)
def test_reaches_the_known_score(tmp_path, env_id, frames, threshold):
    pgkit(
        "run",
        "ppo",
        "--env-id",
        env_id,
        "--seed",
        11,
        "--total-frames",
        frames,
        "--run-dir",
        tmp_path / "run",
    )
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["eval/mean_reward"] >= threshold
