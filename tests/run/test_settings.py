import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from pgkit.errors import UserError
from pgkit.run.settings import RunArgs, launch, parse


@dataclass
class Args(RunArgs):
    learning_rate: float = 3e-4
    """Step size."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths."""


@dataclass
class Variant(Args):
    variant: str = ""
    """Settings to start from."""


PRESETS = {
    "dm_control/cheetah*": {"learning_rate": 0.1},
    "dm_control/*": {"learning_rate": 0.2, "num_envs": 3},
    "CartPole-v1": {"hidden": (32,)},
}


def test_flags_beat_the_preset_which_beats_the_default(capsys: pytest.CaptureFixture[str]):
    args = parse(Args, PRESETS, ["--env-id", "dm_control/hopper-hop-v0", "--learning-rate", "0.5"])
    assert (args.learning_rate, args.num_envs, args.hidden) == (0.5, 3, (64, 64))
    assert capsys.readouterr().out == "preset dm_control/*: num_envs=3\n"


def test_flags_beat_the_preset_which_beats_the_variant(capsys: pytest.CaptureFixture[str]):
    variants = {"fast": {"learning_rate": 0.9, "num_envs": 16, "seed": 7}}
    args = parse(
        Variant, PRESETS, ["--variant", "fast", "--env-id", "dm_control/hopper-hop-v0", "--seed", "8"], variants
    )
    assert (args.learning_rate, args.num_envs, args.seed, args.variant) == (0.2, 3, 8, "fast")
    assert capsys.readouterr().out == "preset dm_control/*: learning_rate=0.2 num_envs=3\n"
    assert parse(Variant, PRESETS, ["--variant=fast"], variants).learning_rate == 0.9
    assert capsys.readouterr().out.startswith("variant fast: learning_rate=0.9 num_envs=16 seed=7\n")
    with pytest.raises(UserError, match="--variant slow: this recipe has fast"):
        parse(Variant, PRESETS, ["--variant", "slow"], variants)


def test_the_first_pattern_that_fits_is_the_only_one_used():
    args = parse(Args, PRESETS, ["--env-id=dm_control/cheetah-run-v0"])
    assert (args.learning_rate, args.num_envs) == (0.1, 8)


def test_the_default_env_has_its_preset_and_an_unknown_one_has_none(capsys: pytest.CaptureFixture[str]):
    assert parse(Args, PRESETS, []).hidden == (32,)
    capsys.readouterr()
    assert parse(Args, PRESETS, ["--env_id", "Other-v0"]).hidden == (64, 64)
    assert capsys.readouterr().out == ""


def saved_run(path: Path, **settings: object) -> Path:
    path.mkdir()
    (path / "config.json").write_text(json.dumps({"recipe": "ppo", "settings": settings, "resumed_at": []}))
    return path


def test_resume_takes_the_saved_settings_and_not_the_preset(tmp_path: Path):
    run_dir = saved_run(tmp_path / "r", env_id="CartPole-v1", hidden=[8, 8], learning_rate=0.7, total_frames=10)
    args = parse(Args, PRESETS, ["--resume", str(run_dir), "--total-frames", "99"])
    assert (args.hidden, args.learning_rate, args.total_frames) == ((8, 8), 0.7, 99)
    assert args.run_dir == args.resume == run_dir


@pytest.mark.parametrize(
    ("settings", "flags", "message"),
    [
        ({"env_id": "CartPole-v1"}, ["--env-id", "Hopper-v5"], "trains on CartPole-v1"),
        ({}, ["--run-dir", "elsewhere"], "--run-dir elsewhere"),
        ({"clip_epsilon": 0.2}, [], "run of ppo; this recipe has no setting clip_epsilon"),
    ],
)
def test_a_resume_that_cannot_be_meant(tmp_path: Path, settings: dict, flags: list[str], message: str):
    run_dir = saved_run(tmp_path / "r", **settings)
    with pytest.raises(UserError, match=message):
        parse(Args, PRESETS, ["--resume", str(run_dir), *flags])


def test_resume_of_something_else_than_a_run(tmp_path: Path):
    with pytest.raises(UserError, match="not a run directory"):
        parse(Args, PRESETS, ["--resume", str(tmp_path)])


def test_launch_turns_a_user_error_into_one_line_and_exit_2(capsys: pytest.CaptureFixture[str]):
    def main(args: Args) -> None:
        raise UserError("no such thing")

    with pytest.raises(SystemExit) as exit_:
        launch(main, Args, argv=[])
    assert exit_.value.code == 2
    assert capsys.readouterr().err == "error: no such thing\n"


def test_launch_lets_other_errors_through_and_ctrl_c_exits_130():
    def broken(args: Args) -> None:
        raise ZeroDivisionError

    def stopped(args: Args) -> None:
        raise KeyboardInterrupt

    with pytest.raises(ZeroDivisionError):
        launch(broken, Args, argv=[])
    with pytest.raises(SystemExit) as exit_:
        launch(stopped, Args, argv=[])
    assert exit_.value.code == 130


def test_a_bad_flag_exits_2(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_:
        launch(lambda args: None, Args, argv=["--total-frames", "many"])
    assert exit_.value.code == 2
