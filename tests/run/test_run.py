import csv
import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from pgkit import envs, files, run
from pgkit.errors import Diverged, UserError
from pgkit.run import RunArgs, directory
from pgkit.run.metrics import averages

Row = dict[str, str]


def arguments(path: Path, total: int = 40, **settings: Any) -> RunArgs:
    return RunArgs(env_id="Fake/Count-v0", run_dir=path, total_frames=total, **{"eval_every": 20, **settings})


def rows(path: Path, timed: bool = False) -> list[Row]:
    with (path / "metrics.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if timed or not k.startswith("time/")} for row in csv.DictReader(file)]


def test_a_run_leaves_what_the_design_promises(kit: SimpleNamespace, tmp_path: Path, capsys: Any):
    path = tmp_path / "r"
    kit.train(arguments(path))
    config = json.loads((path / "config.json").read_text())
    assert config["settings"]["total_frames"] == 40 and config["settings"]["run_dir"] == str(path)
    assert config["recipe"] == "walk" and config["versions"]["torch"] == torch.__version__
    assert "git_revision" in config
    assert next(iter(rows(path, timed=True)[0])) == "frames"
    assert {"time/fps", "time/wall_s"} < set(rows(path, timed=True)[0])
    assert [row["rollout/ep_rew_mean"] for row in rows(path)] == ["10.0", "15.0", "20.0", "25.0"]
    assert [row["eval/mean_reward"] != "" for row in rows(path)] == [False, True, False, True]
    summary = json.loads((path / "summary.json").read_text())
    assert summary["frames"] == 40 and summary["rollout/ep_rew_mean"] == 25.0 and summary["time/fps"] > 0
    assert str(summary["eval/mean_reward"]) == rows(path)[-1]["eval/mean_reward"]
    assert (path / "curve.png").read_bytes()[:4] == b"\x89PNG"
    assert sorted(p.name for p in (path / "checkpoints").iterdir()) == ["best.pt", "latest.pt"]
    out = capsys.readouterr().out
    assert out.count("frames/s") == 2  # one line an evaluation on a pipe
    for command in (f"--resume {path} --total-frames 80", f"pgkit eval {path}", f"pgkit plot {path}"):
        assert command in out


def test_the_same_seed_gives_the_same_metrics_and_another_does_not(kit: SimpleNamespace, tmp_path: Path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        kit.train(arguments(tmp_path / name, seed=seed))
    assert rows(tmp_path / "a") == rows(tmp_path / "b") != rows(tmp_path / "c")


def test_a_row_every_so_many_frames_has_the_means_since_the_last(kit: SimpleNamespace, tmp_path: Path):
    kit.train(arguments(tmp_path / "all"))
    kit.train(arguments(tmp_path / "some"), every=20)
    every = [float(r["train/draw"]) for r in rows(tmp_path / "all")]
    some = rows(tmp_path / "some")
    assert [r["frames"] for r in some] == ["20", "40"]
    assert [float(r["train/draw"]) for r in some] == [sum(every[:2]) / 2, sum(every[2:]) / 2]


def test_an_evaluation_is_not_late_for_a_row(kit: SimpleNamespace, tmp_path: Path):
    often = arguments(tmp_path / "r", total=80)
    often.eval_every = 10
    kit.train(often, every=40)
    assert [row["frames"] for row in rows(tmp_path / "r") if row["eval/mean_reward"]] == [
        "10",
        "20",
        "30",
        "40",
        "50",
        "60",
        "70",
        "80",
    ]


def test_evaluating_does_not_change_the_training(kit: SimpleNamespace, tmp_path: Path):
    kit.train(arguments(tmp_path / "often"))
    seldom = arguments(tmp_path / "seldom")
    seldom.eval_every = 0
    kit.train(seldom)
    assert [r["train/draw"] for r in rows(tmp_path / "often")] == [r["train/draw"] for r in rows(tmp_path / "seldom")]


def test_forty_frames_equal_twenty_and_twenty_more(kit: SimpleNamespace, tmp_path: Path):
    kit.train(arguments(tmp_path / "whole"))
    kit.train(arguments(tmp_path / "half", total=20))
    kit.train(arguments(tmp_path / "half", resume=tmp_path / "half"))
    assert rows(tmp_path / "whole") == rows(tmp_path / "half")
    assert json.loads((tmp_path / "half/config.json").read_text())["resumed_at"] == [20]
    whole, half = (json.loads((tmp_path / n / "summary.json").read_text()) for n in ("whole", "half"))
    assert {k: v for k, v in whole.items() if not k.startswith(("time", "wall"))} == {
        k: v for k, v in half.items() if not k.startswith(("time", "wall"))
    }


def test_rows_logged_after_the_checkpoint_are_dropped_on_resume(kit: SimpleNamespace, tmp_path: Path):
    def crash(frames: int) -> None:
        if frames == 30:
            raise OSError("power cut")

    kit.train(arguments(tmp_path / "whole"))
    with pytest.raises(OSError, match="power cut"):
        kit.train(arguments(tmp_path / "r"), hook=crash)
    assert len(rows(tmp_path / "r")) == 3
    kit.train(arguments(tmp_path / "r", resume=tmp_path / "r"))
    assert rows(tmp_path / "r") == rows(tmp_path / "whole")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_finishes_the_step_saves_and_can_be_resumed(
    kit: SimpleNamespace, tmp_path: Path, capsys: Any, number: signal.Signals
):
    def interrupt(frames: int) -> None:
        if frames == 20:
            os.kill(os.getpid(), number)

    handler = signal.getsignal(number)
    kit.train(arguments(tmp_path / "whole"))
    with pytest.raises(KeyboardInterrupt):
        kit.train(arguments(tmp_path / "r"), hook=interrupt)
    assert len(rows(tmp_path / "r")) == 3 and not (tmp_path / "r/summary.json").exists()
    assert f"--resume {tmp_path / 'r'} --total-frames 40" in capsys.readouterr().out
    assert signal.getsignal(number) is handler
    kit.train(arguments(tmp_path / "r", resume=tmp_path / "r"))
    assert rows(tmp_path / "r") == rows(tmp_path / "whole")


def test_a_run_that_is_stopped_at_its_last_step_is_evaluated_by_a_resume_and_goes_on(
    kit: SimpleNamespace, tmp_path: Path
):
    def interrupt(frames: int) -> None:
        if frames == 30:
            os.kill(os.getpid(), signal.SIGTERM)

    path = tmp_path / "r"
    with pytest.raises(KeyboardInterrupt):
        kit.train(arguments(path, eval_every=0), hook=interrupt)
    assert not list((path / "checkpoints").glob("best.pt"))
    kit.train(arguments(path, eval_every=0, resume=path))
    assert (path / "checkpoints" / "best.pt").exists() and len(rows(path)) == 5
    kit.train(arguments(path, total=80, eval_every=0, resume=path))
    assert len(rows(path)) == 9


def test_a_failed_or_stopped_evaluation_costs_no_training(kit: SimpleNamespace, tmp_path: Path, monkeypatch: Any):
    def stop(*_: Any) -> Any:
        os.kill(os.getpid(), signal.SIGINT)  # once: an evaluation ends at the first Ctrl-C
        pytest.fail("went on")

    for place, error, fail in (("a", KeyboardInterrupt, stop), ("b", ZeroDivisionError, lambda *_: 1 / 0)):
        with monkeypatch.context() as patch:
            patch.setattr("pgkit.run.run.evaluate", fail)
            with pytest.raises(error):
                kit.train(arguments(tmp_path / place))
        assert (tmp_path / place / "checkpoints" / "latest.pt").exists()
        assert len(rows(tmp_path / place)) == 2
        kit.train(arguments(tmp_path / place, resume=tmp_path / place))
        assert len(rows(tmp_path / place)) == 4


def test_an_environment_is_no_function_that_makes_one(kit: SimpleNamespace, tmp_path: Path):
    with (
        pytest.raises(UserError, match="takes a function that makes an environment, this is a VectorEnv"),
        run.Run(arguments(tmp_path / "r"), "toy") as log,
    ):
        log.track(policy=kit.policy(), eval_env=envs.make("Pendulum-v1"))


def test_a_metric_that_is_no_number_is_named(kit: SimpleNamespace):
    with pytest.raises(UserError, match=r"the metric 'my/x' is a ndarray \(2,\): log one number"):
        averages([{"my/x": np.ones(2)}])


def test_a_directory_with_a_run_is_refused_and_stays_as_it_is(kit: SimpleNamespace, tmp_path: Path):
    kit.train(arguments(tmp_path / "r"))
    before = {p: p.read_bytes() for p in (tmp_path / "r").rglob("*") if p.is_file()}
    with pytest.raises(UserError, match="already holds a run"):
        kit.train(arguments(tmp_path / "r", seed=5))
    assert {p: p.read_bytes() for p in (tmp_path / "r").rglob("*") if p.is_file()} == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recipe": "other"}, "holds a run of walk, not of other"),
        ({"total": 40}, "already trained 40 frames"),
        ({"extra": {"second": torch.nn.Linear(1, 1)}}, "this recipe tracks agent, counter, second"),
    ],
)
def test_a_resume_that_cannot_work_writes_nothing(
    kit: SimpleNamespace, tmp_path: Path, change: dict[str, Any], message: str
):
    kit.train(arguments(tmp_path / "r"))
    before = {p: p.read_bytes() for p in (tmp_path / "r").rglob("*") if p.is_file()}
    args = arguments(tmp_path / "r", total=change.get("total", 80), resume=tmp_path / "r")
    with pytest.raises(UserError, match=message):
        kit.train(args, recipe=change.get("recipe", "walk"), **change.get("extra", {}))
    assert {p: p.read_bytes() for p in (tmp_path / "r").rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("name", ["config.json", "checkpoints/latest.pt"])
def test_a_damaged_file_is_named(kit: SimpleNamespace, tmp_path: Path, name: str):
    kit.train(arguments(tmp_path / "r"))
    (tmp_path / "r" / name).write_bytes(b"{ half")
    with pytest.raises(UserError, match=f"{name} (cannot be read|is damaged): "):
        kit.train(arguments(tmp_path / "r", total=80, resume=tmp_path / "r"))


def test_a_run_without_a_checkpoint_cannot_be_resumed(kit: SimpleNamespace, tmp_path: Path):
    kit.train(arguments(tmp_path / "r"))
    (tmp_path / "r/checkpoints/latest.pt").unlink()
    with pytest.raises(UserError, match="has no checkpoint"):
        kit.train(arguments(tmp_path / "r", total=80, resume=tmp_path / "r"))
    with pytest.raises(UserError, match="already holds a run: give another --run-dir, or delete it: it has no checkp"):
        kit.train(arguments(tmp_path / "r"))


@pytest.mark.fault(
    kind=2,
    injected="a loss that becomes NaN",
    outcome="one warning names it and the frames; the run ends with exit code 3",
)
def test_a_run_that_diverges_says_so_once(kit: SimpleNamespace, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    def diverge() -> None:
        with run.Run(arguments(tmp_path / "r"), "walk") as log:
            log.track(policy=kit.policy(), eval_env=kit.Env)
            for frames in (10, 20, 30):
                log.step(frames, None, {"loss_actor": 1.0 if frames < 20 else float("nan")})

    with pytest.raises(Diverged, match=r"train/loss_actor is not finite at the end \(30 frames\)"):
        diverge()
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1 and said[0].startswith("train/loss_actor is nan at 20 frames: the training has diverged")


def test_an_error_before_track_leaves_no_directory(tmp_path: Path):
    from pgkit.run import Run

    with pytest.raises(UserError, match="no such env"), Run(arguments(tmp_path / "r"), "walk"):
        raise UserError("no such env")
    assert not (tmp_path / "r").exists()


def test_stopping_early_is_a_break(kit: SimpleNamespace, tmp_path: Path):
    from pgkit.run import Run

    with Run(arguments(tmp_path / "r"), "walk") as log:
        log.track(policy=kit.policy(), eval_env=kit.Env)
        log.step(10, None, {"x": 1.0, "own/y": 2.0})
    last = rows(tmp_path / "r")[-1]
    assert last["frames"] == "10" and last["eval/mean_reward"] != ""
    assert {"train/x", "own/y"} < last.keys()
    assert json.loads((tmp_path / "r/summary.json").read_text())["frames"] == 10


def test_the_default_directory_names_env_recipe_and_seed(kit: SimpleNamespace, tmp_path: Path, monkeypatch: Any):
    monkeypatch.chdir(tmp_path)
    args = arguments(tmp_path)
    args.run_dir = None
    log = kit.train(args)
    assert log.dir.parent == Path("runs") and log.dir.name.startswith("Fake-Count-v0__walk__1__20")


def test_an_evaluation_environment_that_cannot_be_made_is_said_before_training(tmp_path: Path):
    for make, message in (
        (lambda: envs.make("Pendulum-v1"), r"is called as eval_env\(num_envs=, seed=\)"),
        (lambda num_envs, seed: gym.make("Pendulum-v1"), "plays what envs.make gives, a TimeLimit is none of that"),
    ):
        with run.Run(arguments(tmp_path / "r"), "walk") as log, pytest.raises(UserError, match=message):
            log.track(policy=torch.nn.Identity(), eval_env=make)
        assert not (tmp_path / "r").exists()


def test_a_run_resumed_from_python_keeps_its_settings(kit: SimpleNamespace, tmp_path: Path, caplog: Any):
    kit.train(arguments(tmp_path / "r", seed=5))
    args = RunArgs(env_id="Fake/Count-v0", resume=tmp_path / "r", total_frames=80)
    kit.train(args)
    assert args.seed == 5 and "keeps its own settings: seed=5" in caplog.text
    assert json.loads((tmp_path / "r" / "config.json").read_text())["settings"]["seed"] == 5


def test_a_kill_between_two_files_loses_no_best_policy(kit: SimpleNamespace, tmp_path: Path, monkeypatch: Any):
    def killed(path: Path, content: Any) -> None:
        if saved:
            raise KeyboardInterrupt
        saved.append(path.name)
        save(path, content)

    save, saved = files.save, []
    with monkeypatch.context() as patch:
        patch.setattr("pgkit.files.save", killed)
        with pytest.raises(KeyboardInterrupt):
            kit.train(arguments(tmp_path / "r"))
    assert saved == ["best.pt"]  # of the two, latest comes last: it says that there is a best


@pytest.mark.fault(
    kind=19,
    injected="two processes that resume one run",
    outcome="the second is refused in one line",
)
def test_two_processes_do_not_go_on_with_one_run(kit: SimpleNamespace, tmp_path: Path):
    kit.train(arguments(tmp_path / "r"))
    held = directory.lock(tmp_path / "r")
    with pytest.raises(UserError, match="another process goes on with this run"):
        kit.train(arguments(tmp_path / "r", resume=tmp_path / "r", total=80))
    directory.unlock(held)
    kit.train(arguments(tmp_path / "r", resume=tmp_path / "r", total=80))
    assert len(rows(tmp_path / "r")) == 8


def test_a_run_that_ends_before_its_first_row_leaves_no_directory(kit: SimpleNamespace, tmp_path: Path):
    for name, kept in (("bare", False), ("notes", True)):
        path = tmp_path / name
        if kept:
            path.mkdir()
            (path / "mine.txt").write_text("")
        with pytest.raises(ZeroDivisionError), run.Run(arguments(path), "toy") as log:
            log.track(policy=kit.policy(), eval_env=kit.Env)
            _ = 1 / 0
        assert path.exists() == kept
        assert not (path / "config.json").exists()


@pytest.mark.fault(
    kind=32,
    injected="`log.step(...)` in a loop of one's own",
    outcome="it returns the row that it logged",
)
def test_a_step_returns_its_row_evaluation_included(kit: SimpleNamespace, tmp_path: Path):
    with run.Run(arguments(tmp_path / "r"), "walk") as log:
        log.track(policy=kit.policy(), eval_env=kit.Env)
        first, second = log.step(10, None, {"x": 1.0}), log.step(20)
        assert log.step(21, every=10) == {}
    assert first["frames"] == 10 and first["train/x"] == 1.0 and "eval/mean_reward" not in first
    assert str(second["eval/mean_reward"]) == rows(tmp_path / "r")[1]["eval/mean_reward"]


def test_compile_seconds_of_what_is_tracked_do_not_count(kit: SimpleNamespace, tmp_path: Path, monkeypatch: Any):
    class Compiled(kit.Counter):
        compile_seconds = 0.0

    update, collector = Compiled(), Compiled()
    with run.Run(arguments(tmp_path / "r"), "walk") as log:
        log.track(policy=kit.policy(), eval_env=kit.Env, update=update, collector=collector)
        asked: list[float] = []
        monkeypatch.setattr(log._clock, "fps", lambda frames, seconds: asked.append(seconds) or 1.0)
        log.step(10)
        update.compile_seconds, collector.compile_seconds = 3.0, 0.5
        log.step(20)
        log.step(30, compile_seconds=7.0)
    assert asked == [0.0, 3.5, 7.0]


def test_an_error_saves_what_was_trained_first(kit: SimpleNamespace, tmp_path: Path, caplog: Any, capsys: Any):
    def crash(frames: int) -> None:
        if frames == 30:
            raise ZeroDivisionError("the environment's")

    kit.train(arguments(tmp_path / "whole"))
    with pytest.raises(ZeroDivisionError):
        kit.train(arguments(tmp_path / "r"), hook=crash)
    assert files.load(tmp_path / "r" / "checkpoints" / "latest.pt")["frames"] == 30
    assert f"the run ends at an error; {tmp_path / 'r'} has the checkpoint of 30 frames" in caplog.text
    kit.train(arguments(tmp_path / "r", resume=tmp_path / "r"))
    assert rows(tmp_path / "r") == rows(tmp_path / "whole")


def test_an_error_amid_an_update_keeps_the_checkpoint_before(kit: SimpleNamespace, tmp_path: Path, caplog: Any):
    class Update(kit.Counter):
        def __call__(self) -> None:
            self.frames += 10
            _ = 1 / (40 - self.frames)

    with pytest.raises(ZeroDivisionError), run.Run(arguments(tmp_path / "r"), "walk") as log:
        update = Update()
        log.track(policy=kit.policy(), eval_env=kit.Env, update=update)
        while True:
            update()
            log.step(update.frames)
    assert files.load(tmp_path / "r" / "checkpoints" / "latest.pt")["states"]["update"] == {"frames": 20}
    assert "the checkpoint of 20 frames (the error came in the middle of an update)" in caplog.text


def test_an_exit_from_within_is_no_success(kit: SimpleNamespace, tmp_path: Path):
    def leave(frames: int) -> None:
        raise SystemExit(0)

    with pytest.raises(UserError, match=r"something called sys.exit\(0\) after 10 frames"):
        kit.train(arguments(tmp_path / "r"), hook=leave)
    assert files.load(tmp_path / "r" / "checkpoints" / "latest.pt")["frames"] == 10


@pytest.mark.fault(
    kind=2,
    injected="weights that are NaN or infinite when a checkpoint is due",
    outcome="the checkpoints before stay; exit code 3",
)
def test_weights_that_are_not_finite_replace_no_checkpoint(kit: SimpleNamespace, tmp_path: Path):
    policy = kit.policy(1.0)
    with (
        pytest.raises(Diverged, match="not finite at 40 frames: .* keeps its checkpoint of 20 frames"),
        run.Run(arguments(tmp_path / "r"), "walk") as log,
    ):
        log.track(policy=policy, eval_env=kit.Env)
        log.step(20)
        torch.nn.init.constant_(policy.module.weight, float("nan"))
        log.step(40)
    latest = files.load(tmp_path / "r" / "checkpoints" / "latest.pt")
    assert latest["frames"] == 20 and latest["states"]["agent"]["parts"]["actor"]["module.weight"].tolist() == [[1, 1]]


def test_a_hangup_that_nohup_ignores_stays_ignored(kit: SimpleNamespace, tmp_path: Path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        kit.train(arguments(tmp_path / "r"), hook=lambda _: os.kill(os.getpid(), signal.SIGHUP))
    finally:
        signal.signal(signal.SIGHUP, before)
    assert len(rows(tmp_path / "r")) == 4
