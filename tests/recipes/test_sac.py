"""The SAC recipe as a user runs it."""

import json

import pytest

from tests.recipes.test_ppo import pgkit, rows


def train(run_dir, *argv, frames=600, name="sac", ok=True):
    flags = [
        "--env-id",
        "Pendulum-v1",
        "--eval-every",
        300,
        "--eval-episodes",
        1,
        "--random-frames",
        100,
        "--log-every",
        50,
    ]
    small = ["--batch-size", 32, "--hidden", 16, "--threads", 1, "--compile", "off"]
    return pgkit("run", name, *flags, *small, "--total-frames", frames, "--run-dir", run_dir, *argv, ok=ok)


def test_resumed_with_its_buffer_it_equals_the_straight_run(tmp_path):
    train(tmp_path / "straight", "--save-buffer")
    train(tmp_path / "resumed", "--save-buffer", frames=300)
    pgkit("run", "sac", "--resume", tmp_path / "resumed", "--total-frames", 600)
    assert rows(tmp_path / "straight") == rows(tmp_path / "resumed")
    assert rows(tmp_path / "straight")[-1]["train/loss_qvalue"]


def test_resumed_without_its_buffer_it_says_so_and_goes_on(tmp_path, caplog):
    train(tmp_path / "run", frames=300)
    pgkit("run", "sac", "--resume", tmp_path / "run", "--total-frames", 600)
    assert "resumed without the replay buffer" in caplog.text
    assert int(rows(tmp_path / "run")[-1]["frames"]) >= 600


def test_a_run_shorter_than_its_random_frames_trains(tmp_path):
    train(tmp_path / "run", "--random-frames", 5000, frames=300)
    assert rows(tmp_path / "run")[-1]["train/loss_qvalue"]


@pytest.mark.parametrize(
    "flags",
    [
        ("--env-id", "Hopper-v5", "--num-envs", 2, "--steps", 5, "--workers", 2, "--actor-delay", 2),
        ("--env-id", "dm_control/cartpole-swingup-v0", "--action-repeat", 4, "--n-step", 3, "--replay", "prioritized"),
        ("--env-id", "Pendulum-v1", "--alpha", 0.1, "--updates-per-step", 0.25),
    ],
)
def test_runs_for_a_few_hundred_frames(tmp_path, flags):
    train(tmp_path / "run", *flags, frames=300)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"] >= 300


@pytest.mark.parametrize(
    "flags",
    [
        ("--critic", "layernorm", "--value-head", "quantile", "--num-critics", 3, "--subset", 2, "--n-step", 3),
        ("--critic", "simba", "--value-head", "categorical", "--replay", "prioritized", "--critic-hidden", 8, 8),
        (
            "--critic",
            "crossq",
            "--value-head",
            "quantile",
            "--num-critics",
            3,
            "--subset",
            1,
            "--replay",
            "prioritized",
        ),
        ("--critic", "droq", "--value-head", "categorical", "--actor-value", "mean", "--updates-per-step", 2.0),
    ],
)
def test_the_flags_are_orthogonal(tmp_path, flags):
    train(tmp_path / "run", *flags, frames=200)
    assert rows(tmp_path / "run")[-1]["train/loss_qvalue"]


@pytest.mark.parametrize("name", ["redq", "droq", "tqc", "crossq"])
def test_a_variant_is_a_name_for_settings_and_resumes_under_it(tmp_path, name):
    small = ["--updates-per-step", 0.25, "--save-buffer"]
    done = train(tmp_path / "straight", *small, name=name)
    assert f"variant {name}: " in done.stdout and f"pgkit run {name} --resume" in done.stdout
    train(tmp_path / "resumed", *small, name=name, frames=300)
    pgkit("run", name, "--resume", tmp_path / "resumed", "--total-frames", 600)
    assert rows(tmp_path / "straight") == rows(tmp_path / "resumed")
    config = json.loads((tmp_path / "resumed" / "config.json").read_text())
    assert config["recipe"] == config["settings"]["variant"] == name
    assert config["settings"]["updates_per_step"] == 0.25


def test_a_copied_variant_is_run_by_the_command_that_cp_prints(tmp_path):
    done = pgkit("cp", "redq", tmp_path / "mine.py")
    command = done.stdout.split("pgkit ")[-1].split()
    assert command == ["run", str(tmp_path / "mine.py"), "--variant", "redq"]
    done = train(tmp_path / "run", *command[2:], "--updates-per-step", 0.1, name=command[1], frames=200)
    assert "num_critics=10 subset=2" in done.stdout
    done = train(tmp_path / "other", "--variant", "rdq", ok=False)
    assert done.returncode == 2 and "--variant rdq: this recipe has redq, droq, tqc, crossq" in done.stderr


def test_memmap_buffer(tmp_path):
    train(tmp_path / "run", "--buffer-dir", tmp_path / "replay", "--buffer-size", 500, frames=300)
    pgkit("run", "sac", "--resume", tmp_path / "run", "--total-frames", 350)  # into files of its own


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--env-id", "CartPole-v1"), "categorical_actor"),
        (("--batch-size", 256, "--buffer-size", 10), "raise its capacity (--buffer-size)"),
    ],
)
def test_mistakes_are_one_line_and_exit_2(tmp_path, flags, message):
    done = pgkit("run", "sac", "--run-dir", tmp_path / "run", *flags, ok=False)
    assert done.returncode == 2 and message in done.stderr and "Traceback" not in done.stderr
