import dataclasses
import importlib
import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from pgkit.errors import UserError
from pgkit.run import setting
from pgkit.run.args import free_on_resume
from pgkit.run.settings import RunArgs, check, launch, parse


@dataclass
class Args(RunArgs):
    learning_rate: float = setting(3e-4, low=0)
    """Step size."""
    hidden: tuple[int, ...] = setting((64, 64), low=1)
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


def test_an_id_without_a_version_has_the_preset_of_its_versions():
    for env_id, seed in (("Hopper", 7), ("Hopper-v5", 7), ("HopperB", 1)):
        assert parse(Args, {"Hopper-*": {"seed": 7}}, ["--env-id", env_id]).seed == seed


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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--total-frames many", "Error parsing --total-frames: invalid literal for int() with base 10: 'many'"),
        ("--compile maybe", "invalid choice 'maybe' for argument '--compile'. Expected one of ('auto', 'on', 'off')."),
        ("--wokers 3", "Unrecognized options: --wokers; the nearest are --workers"),
        ("CartPole-v1", "Unrecognized options: CartPole-v1; did you mean --env-id CartPole-v1?"),
        ("--lr 0.1", "Unrecognized options: --lr; the nearest are --learning-rate"),
        ("--frames=3", "Unrecognized options: --frames; the nearest are --total-frames"),
        ("--env.continuous --seed 3", "--env.continuous: give a value, as in --env.continuous True"),
    ],
)
def test_a_bad_flag_is_one_line_and_exits_2(capsys: pytest.CaptureFixture[str], words: str, message: str):
    with pytest.raises(SystemExit) as exit_:
        launch(lambda args: None, Args, argv=words.split())
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {message}") and (error.endswith(" --help)\n") or "--env." in words)
    assert error.count("\n") == 1


def test_help_is_on_stdout_and_names_the_env_of_its_defaults(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_:
        parse(Args, PRESETS, ["--env-id", "dm_control/hopper-hop-v0", "--help"])
    assert not exit_.value.code
    out = capsys.readouterr().out
    assert "--env-id dm_control/hopper-hop-v0." in " ".join(out.split()) and "(default: 0.2)" in out


def test_whole_numbers_may_have_an_exponent():
    args = parse(Args, {}, ["--total-frames", "1e6", "--hidden", "32", "32", "--learning-rate", "1e-3"])
    assert (args.total_frames, args.hidden, args.learning_rate) == (1_000_000, (32, 32), 1e-3)
    with pytest.raises(UserError, match="--total-frames"):
        parse(Args, {}, ["--total-frames", "1e-3"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"hidden": (64, 0)}, "--hidden 0: give at least 1"),
        ({"learning_rate": -1.0}, "--learning-rate -1.0: give at least 0"),
        ({"seed": -1}, "--seed -1: give at least 0"),
        ({"old_rollouts": -1}, "--old-rollouts -1: give at least 0"),
        ({"gamma": 1.5}, "--gamma 1.5: give at most 1"),
        ({"gamma": float("nan")}, "--gamma nan: give a finite number"),
        ({"learning_rate": float("inf")}, "--learning-rate inf: give a finite number"),
        ({"log_std": float("nan")}, "--log-std nan: give a finite number"),
        ({"max_grad_norm": 0.0}, "--max-grad-norm 0.0: give a number above 0"),
        ({"old_rollouts": 2**63}, "--old-rollouts 9223372036854775808: give at most 4.6"),
        ({"threads": 1_000_000}, "--threads 1000000: give at most 256"),
    ],
)
def test_numbers_that_no_run_can_have(given: dict, message: str):
    @dataclass
    class Discounted(Args):
        gamma: float | None = setting(None, low=0, high=1)
        old_rollouts: int = setting(3, low=0)
        log_std: float = -0.5  # a setting without bounds
        max_grad_norm: float | None = setting(None, above=0)
        learning_rate: float = 0.5  # another default, the same bounds

    check(Discounted())
    with pytest.raises(UserError, match=message):
        check(Discounted(**given))


@dataclass
class Annealed(Args):
    anneal: bool = setting(True, follows="total_frames")


def test_a_stretched_annealing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    settings = {"env_id": "X-v0", "total_frames": 1000, "anneal": True}
    (tmp_path / "config.json").write_text(json.dumps({"recipe": "walk", "settings": settings}))
    parse(Annealed, {}, ["--resume", str(tmp_path)])
    assert capsys.readouterr().out == ""
    parse(Annealed, {}, ["--resume", str(tmp_path), "--total-frames", "2000"])
    assert "--anneal ends at 2,000 frames, no longer at 1,000: it jumps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("recipe", "flag"),
    [
        ("ppo", "--clip-epsilon"), ("ppo", "--log-std"), ("ppo_penalty", "--beta"), ("sac", "--alpha"),
        ("sac", "--alpha-init"), ("sac", "--beta1"), ("td3", "--policy-noise"), ("td3", "--noise-clip"),
        ("dqn", "--epsilon-end"), ("rainbow", "--v-min"), ("rainbow", "--v-max"), ("rainbow", "--noise"),
        ("sac", "--updates-per-step"),
    ],
)  # fmt: skip
def test_other_settings_are_refused_on_resume(tmp_path: Path, recipe: str, flag: str):
    args_class = importlib.import_module(f"recipes.{recipe}").Args
    settings = {key: value for key, value in dataclasses.asdict(args_class()).items() if key != "run_dir"}
    run_dir = saved_run(tmp_path / "run", **settings)
    assert not {name for name in ("learning_rate", "anneal", "gamma") if name in free_on_resume(args_class)}
    with pytest.raises(UserError, match=f"{flag} 0.77: a resumed run keeps its own"):
        parse(args_class, {}, ["--resume", str(run_dir), flag, "0.77"])


def test_a_resumed_run_keeps_its_settings_and_may_go_on_longer(tmp_path: Path):
    run_dir = saved_run(tmp_path / "run", env_id="Walk-v0", learning_rate=0.5)
    with pytest.raises(UserError, match="--learning-rate 0.1: a resumed run keeps its own, 0.5"):
        parse(Args, {}, ["--resume", str(run_dir), "--learning-rate", "0.1"])
    assert parse(Args, {}, ["--resume", str(run_dir), "--learning-rate", "0.5", "--eval-every", "7"]).eval_every == 7


def test_keywords_of_the_environment_are_kept_and_stay_on_a_resume(tmp_path: Path):
    words = ["--env.continuous", "True", "--env.max-episode-steps=500", "--seed", "3", "--env.name", "a b"]
    args = parse(Args, {}, words)
    assert args.env == {"continuous": True, "max_episode_steps": 500, "name": "a b"} and args.seed == 3
    run_dir = saved_run(tmp_path / "r", env_id="X-v0", env=args.env)
    assert parse(Args, {}, ["--resume", str(run_dir), "--env.continuous", "True"]).env == args.env
    with pytest.raises(UserError, match="--env .*: a resumed run keeps its own"):
        parse(Args, {}, ["--resume", str(run_dir), "--env.continuous", "False"])


@pytest.mark.parametrize(
    "settings",
    [
        {"num_envs": "8"},
        {"env": []},
        {"hidden": ["a"]},
        {"compile": "maybe"},
        {"seed": 1.5},
        {"explain": 1},
        {"env_id": 3},
    ],
)
def test_settings_of_another_type_are_damage(tmp_path: Path, settings: dict):
    run_dir = saved_run(tmp_path / "r", **settings)
    with pytest.raises(UserError, match=f"config.json is damaged: its {next(iter(settings))} is "):
        parse(Args, {}, ["--resume", str(run_dir)])


def test_one_command_begins_and_goes_on(tmp_path: Path):
    words = ["--env-id", "X-v0", "--run-dir", str(tmp_path / "r"), "--resume-if-possible", "--learning-rate", "0.5"]
    args = parse(Args, {}, words)
    assert args.resume is None and args.run_dir == tmp_path / "r"
    saved_run(tmp_path / "r", env_id="X-v0", learning_rate=0.5, resume_if_possible=True)
    assert parse(Args, {}, words).resume is None  # nothing was saved yet
    (tmp_path / "r" / "checkpoints").mkdir()
    (tmp_path / "r" / "checkpoints" / "latest.pt").touch()
    assert parse(Args, {}, words).resume == tmp_path / "r"


def test_a_module_that_a_run_directory_names_is_imported_only_where_it_is_given_or_trusted(tmp_path: Path):
    run_dir = saved_run(tmp_path / "r", env_id="evil:X-v0", wrapper="evil:wrap")
    words = ["--resume", str(run_dir)]
    with pytest.raises(UserError, match="names code to import, --env-id evil:X-v0"):
        parse(Args, {}, words)
    with pytest.raises(UserError, match="names code to import, --wrapper evil:wrap"):
        parse(Args, {}, [*words, "--env-id", "evil:X-v0"])
    assert parse(Args, {}, [*words, "--trust"]).wrapper == "evil:wrap"
    assert parse(Args, {}, [*words, "--env-id", "evil:X-v0", "--wrapper", "evil:wrap"]).trust is False
