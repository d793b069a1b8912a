"""What stops a run, from outside and from within: nothing that was trained is lost, and no half file stays."""

import contextlib
import json
import os
import random
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from pgkit import files, run
from pgkit.cli import recipes
from pgkit.errors import EnvironmentFailed

ROOT = Path(__file__).resolve().parents[2]
STOPS = [signal.SIGTERM, signal.SIGHUP, signal.SIGINT]
SMALL = "--env-id tests.faulty:Faulty-v0 --num-envs 2 --hidden 8 --compile off --eval-episodes 1"
PPO = shlex.split(f"{SMALL} --steps 16 --minibatch-size 16 --epochs 1 --total-frames 512 --eval-every 128")
SAC = shlex.split(
    f"{SMALL} --steps 2 --random-frames 16 --batch-size 8 --total-frames 128 --eval-every 32 --log-every 8 "
    "--save-buffer"
)


class Nursery:
    """Runs that are forked from one process that has imported pgkit."""

    def __init__(self) -> None:
        where = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]), "PYTHONWARNINGS": "ignore"}
        command = [sys.executable, ROOT / "tests/run/nursery.py"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=where, text=True)
        assert self._read() == "ready"

    def start(self, recipe: str, argv: list[str], folder: Path) -> int:
        """Starts a run; its pid, which is that of its process group."""
        folder.mkdir(exist_ok=True)
        assert self.process.stdin
        self.process.stdin.write(json.dumps([recipe, argv, str(folder)]) + "\n")
        self.process.stdin.flush()
        return int(self._read())

    def end(self) -> int:
        """Waits for the end of the run; its exit code."""
        return int(self._read())

    def run(self, recipe: str, argv: list[str], folder: Path) -> int:
        self.start(recipe, argv, folder)
        return self.end()

    def _read(self) -> str:
        assert self.process.stdout
        return self.process.stdout.readline().strip()


@pytest.fixture(scope="module")
def nursery() -> Iterator[Nursery]:
    made = Nursery()
    yield made
    made.process.communicate()


def command(argv: list[str]) -> list[str]:
    return [*argv, "--run-dir", "r", "--resume-if-possible", "--trust"]


def rows(folder: Path) -> list[list[str]]:
    """The rows of metrics.csv, without times and evaluations (one that was stopped is not made again)."""
    head, *lines = [line.split(",") for line in (folder / "r" / "metrics.csv").read_text().splitlines()]
    kept = [i for i, name in enumerate(head) if not name.startswith(("time/", "eval/"))]
    found = [[line[i] for i in kept] for line in lines]
    return [row for row in found if any(row[1:])]  # others are of a last evaluation alone


def latest(folder: Path) -> dict[str, Any]:
    return files.load(folder / "r" / "checkpoints" / "latest.pt")


def names(folder: Path) -> set[str]:
    """The files of a run; of two buffers in turn, any."""
    found = {str(path.relative_to(folder)) for path in (folder / "r").rglob("*") if path.is_file()}
    return {name.replace("buffer-2", "buffer") for name in found if "events" not in name}


def same(a: Any, b: Any) -> bool:
    """Whether two states are equal, bit for bit, apart from times."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a if k not in ("wall_s", "metrics", "file"))
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, torch.Tensor):
        return torch.equal(a.nan_to_num(7.5), b.nan_to_num(7.5)) if a.is_floating_point() else torch.equal(a, b)
    return str(a) == str(b)


@pytest.mark.fault(kind=21, injected="SIGKILL at 40 random moments", outcome="the same command goes on, bit for bit")
@pytest.mark.parametrize(("recipe", "argv"), [("ppo", PPO), ("sac", SAC)])
def test_kills_at_random_moments_cost_no_bit(nursery: Nursery, tmp_path: Path, recipe: str, argv: list[str]):
    draw, kills, number, start = random.Random(recipe), 0, 0, time.monotonic()
    whole = tmp_path / "whole"
    assert nursery.run(recipe, command(argv), whole) == 0, (whole / "out.txt").read_text()
    life = time.monotonic() - start
    while kills < 20:
        number += 1
        folder, code = tmp_path / str(number), 1
        while code != 0:
            pid = nursery.start(recipe, command(argv), folder)
            time.sleep(draw.uniform(0, 0.6 * life))
            with contextlib.suppress(ProcessLookupError):
                if kills < 20:
                    os.killpg(pid, signal.SIGKILL)
            code = nursery.end()
            assert code in (0, -signal.SIGKILL), (folder / "out.txt").read_text()
            kills += code != 0
        assert rows(folder) == rows(whole) and same(latest(folder), latest(whole))
        assert names(folder) == names(whole)


@pytest.mark.fault(
    kind=21,
    injected="SIGTERM, SIGHUP or SIGINT to the whole process group at 20 random moments, with and without workers",
    outcome="the checkpoint is of the last row; the same command goes on, bit for bit",
)
@pytest.mark.parametrize(("workers", "count"), [(1, 14), (2, 6)])
def test_signals_at_random_moments_lose_nothing(nursery: Nursery, tmp_path: Path, workers: int, count: int):
    draw, number, start = random.Random(workers), 0, time.monotonic()
    argv, whole = command([*PPO, "--workers", str(workers)]), tmp_path / "whole"
    assert nursery.run("ppo", argv, whole) == 0, (whole / "out.txt").read_text()
    life = time.monotonic() - start
    while count:
        number += 1
        folder, code = tmp_path / str(number), 1
        while code != 0:
            pid, signal_ = nursery.start("ppo", argv, folder), draw.choice(STOPS)
            time.sleep(draw.uniform(0, 0.6 * life))
            with contextlib.suppress(ProcessLookupError):
                for _ in range(0 if not count else 1 if signal_ == signal.SIGINT else 2):  # `timeout` sends two
                    os.killpg(pid, signal_)
            code = nursery.end()
            assert code in (0, 130, -signal_), (folder / "out.txt").read_text()
            if code and (folder / "r" / "metrics.csv").exists():
                assert latest(folder)["frames"] == int(rows(folder)[-1][0]), (folder / "out.txt").read_text()
            count -= code != 0
        assert rows(folder) == rows(whole)
        assert all(same(latest(folder)["states"][name], latest(whole)["states"][name]) for name in ("agent", "update"))
        assert "Traceback" not in (folder / "out.txt").read_text()


@pytest.mark.fault(
    kind=22,
    injected="an exception, sys.exit(0) or os._exit(0) in an environment of SAC",
    outcome="update and replay saved as of the last whole update; a resume begins new episodes, and says so",
)
@pytest.mark.parametrize("deed", ["raise", "sys.exit", "os._exit"])
def test_an_environment_that_fails_costs_its_rollout_only(tmp_path: Path, caplog: Any, deed: str):
    sac = recipes.load(recipes.find("sac"))
    path, fault = tmp_path / "r", {"deed": deed, "step": 3, "episode": 5, "flag": str(tmp_path / "flag")}
    settings = dict(
        env_id="tests.faulty:Faulty-v0", num_envs=2, hidden=(8,), compile="off", eval_episodes=1, steps=2,
        random_frames=16, batch_size=8, eval_every=32, log_every=8, save_buffer=True, trust=True,
    )  # fmt: skip
    with pytest.raises(
        EnvironmentFailed, match=r"^environment 0 \(Faulty\), step 3 of the episode of reset\(seed=\d+\): "
    ):
        sac.main(sac.Args(**settings, total_frames=96, run_dir=path, env=fault))
    saved = latest(tmp_path)  # 4 episodes of 5 steps and 2 steps in 2 environments; then a step of a rollout of 2
    assert saved["frames"] == saved["states"]["replay"]["written"] == saved["states"]["update"]["counters"][0] == 44
    assert f"the run ends at an error; {path} has the checkpoint of 44 frames" in caplog.text
    with caplog.at_level("INFO", "pgkit"):
        sac.main(sac.Args(**settings, total_frames=96, resume=path, env=fault))
    assert "every environment begins anew: the run before it ended in the middle of a rollout" in caplog.text
    assert latest(tmp_path)["states"]["replay"]["written"] == 96


@pytest.mark.fault(
    kind=22, injected="an exception in an environment, at the command line", outcome="one line, its own frames"
)
def test_a_failing_environment_is_one_line_and_its_own_traceback(nursery: Nursery, tmp_path: Path):
    for deed, code in (("raise", 1), ("os._exit", 1)):
        folder = tmp_path / deed
        assert nursery.run("ppo", [*command(PPO), "--env.deed", deed, "--env.episode", "30"], folder) == code
        text = (folder / "out.txt").read_text()
        assert (
            "the run ends at an error; r has the checkpoint of 288 frames\nerror: environment 0 (Faulty), reset("
            in text
        )
        assert "in _do" in text and "Traceback" not in text
        assert deed == "os._exit" or "pgkit/" not in text.partition("error: environment")[2]


@pytest.mark.fault(
    kind=22, injected="SIGKILL of a worker of a run", outcome="saved as of the last whole update; one line"
)
def test_a_run_outlives_its_workers(nursery: Nursery, tmp_path: Path):
    argv = [*command(PPO), "--env.deed", "kill", "--env.episode", "30", "--env.flag", str(tmp_path / "flag")]
    assert nursery.run("ppo", [*argv, "--workers", "2"], tmp_path / "a") == 1
    text = (tmp_path / "a/out.txt").read_text()
    named = r"error: collector worker (\d) \(environments \1 to \1 of tests.faulty:Faulty-v0"  # either may be first
    assert re.match(named, text.splitlines()[-1])
    assert latest(tmp_path / "a")["frames"] == 288 and "Traceback" not in text
    assert nursery.run("ppo", argv, tmp_path / "a") == 0
    assert "every environment begins anew" in (tmp_path / "a/out.txt").read_text()


def arguments(kit: SimpleNamespace, path: Path, **settings: Any) -> Any:
    return kit.Args(env_id="Fake/Count-v0", run_dir=path / "r", total_frames=40, eval_every=20, **settings)


@pytest.mark.fault(kind=21, injected="a signal while the run starts", outcome="it ends there and leaves nothing")
@pytest.mark.parametrize("number", STOPS)
def test_a_signal_while_a_run_starts_leaves_nothing(kit: SimpleNamespace, tmp_path: Path, number: signal.Signals):
    def slow(num_envs: int, seed: int) -> Any:
        os.kill(os.getpid(), number)
        pytest.fail("went on")

    with pytest.raises(KeyboardInterrupt), run.Run(arguments(kit, tmp_path), "walk") as log:
        log.track(policy=kit.policy(), eval_env=slow)
    assert not (tmp_path / "r").exists()


@pytest.mark.fault(
    kind=21, injected="SIGTERM twice while evaluating", outcome="the evaluation ends, what was trained is saved"
)
def test_signals_amid_an_evaluation_and_the_save_after_it(kit: SimpleNamespace, tmp_path: Path, monkeypatch: Any):
    def slow(*_: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("went on")

    def save(path: Path, content: Any) -> None:
        os.kill(os.getpid(), signal.SIGTERM)  # the second of the two that timeout sends
        whole(path, content)

    whole = files.save
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("pgkit.run.run.evaluate", slow)
        patch.setattr("pgkit.files.save", save)
        kit.train(arguments(kit, tmp_path))
    assert latest(tmp_path)["frames"] == 20 == int(rows(tmp_path)[-1][0])


@pytest.mark.fault(kind=21, injected="signals in the middle of a save", outcome="one file or the other, whole")
@pytest.mark.parametrize(
    ("number", "times", "frames"), [(signal.SIGTERM, 2, 20), (signal.SIGINT, 1, 20), (signal.SIGINT, 2, 0)]
)
def test_signals_amid_a_save(
    kit: SimpleNamespace, tmp_path: Path, monkeypatch: Any, number: signal.Signals, times: int, frames: int
):
    class Interrupting(files._Hashing):
        def write(self, data: Any) -> int:
            if len(calls) < times:
                calls.append(1)
                os.kill(os.getpid(), number)
            return super().write(data)

    calls: list[int] = []
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("pgkit.files._Hashing", Interrupting)
        kit.train(arguments(kit, tmp_path))
    folder = tmp_path / "r" / "checkpoints"
    assert sorted(path.name for path in folder.iterdir()) == (["best.pt", "latest.pt"] if frames else [])
    assert all(files.load(path)["frames"] == frames for path in folder.iterdir())
    kit.train(arguments(kit, tmp_path, resume_if_possible=True))
    assert latest(tmp_path)["frames"] == 40


@pytest.mark.fault(
    kind=21, injected="a signal during the last evaluation", outcome="the same command makes it, and the summary"
)
def test_a_run_that_was_stopped_in_its_last_evaluation_is_finished(
    kit: SimpleNamespace, tmp_path: Path, monkeypatch: Any, capsys: Any
):
    def stop(frames: int) -> None:
        if frames == 30:
            monkeypatch.setattr("pgkit.run.run.evaluate", lambda *_: os.kill(os.getpid(), signal.SIGTERM))

    with pytest.raises(KeyboardInterrupt):
        kit.train(arguments(kit, tmp_path), hook=stop)
    assert latest(tmp_path)["frames"] == 40 and not (tmp_path / "r" / "summary.json").exists()
    monkeypatch.undo()
    kit.train(arguments(kit, tmp_path, resume_if_possible=True))
    assert json.loads((tmp_path / "r" / "summary.json").read_text())["frames"] == 40
    with pytest.raises(SystemExit):
        kit.train(arguments(kit, tmp_path, resume_if_possible=True))
    assert "there is nothing left to do" in capsys.readouterr().out


@pytest.mark.fault(
    kind=25, injected="a second Ctrl-C inside `with params.to_module(...)`", outcome="an interrupt, exit code 130"
)
def test_a_second_ctrl_c_stays_an_interrupt_inside_to_module(kit: SimpleNamespace, tmp_path: Path):
    net = torch.nn.Linear(1, 1)

    def twice(frames: int) -> None:
        if frames == 30:
            with TensorDict.from_module(net).clone().to_module(net):
                for _ in range(2):
                    os.kill(os.getpid(), signal.SIGINT)
                pytest.fail("went on")

    with pytest.raises(KeyboardInterrupt):
        kit.train(arguments(kit, tmp_path), hook=twice)
    assert latest(tmp_path)["frames"] == 20


@pytest.mark.fault(
    kind=21, injected="SIGTERM to the process group while compiling", outcome="the run ends as at any signal"
)
def test_a_signal_while_compiling(nursery: Nursery, tmp_path: Path):
    argv = shlex.split("--env-id tests.faulty:Faulty-v0 --trust --num-envs 2 --total-frames 100 --run-dir r")
    pid = nursery.start("compiles", argv, tmp_path / "a")
    end = time.monotonic() + 60
    while not compiling(pid) and time.monotonic() < end:
        time.sleep(0.01)
    for _ in range(2):
        os.killpg(pid, signal.SIGTERM)
    assert nursery.end() == 130, (tmp_path / "a/out.txt").read_text()  # the compiler was ended, too
    assert "Traceback" not in (tmp_path / "a/out.txt").read_text()


def compiling(group: int) -> bool:
    """Whether a C++ compiler runs in this process group."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            name, _, rest = stat.read_text().partition("(")[2].rpartition(")")
            if name.startswith(("cc1plus", "clang")) and int(rest.split()[2]) == group:
                return True
    return False
