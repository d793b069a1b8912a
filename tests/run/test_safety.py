"""Files of a run directory: no code in them runs, damage is found, and nothing of anyone else's is touched."""

import contextlib
import errno
import hashlib
import io
import json
import os
import pickle
import random
import re
import resource
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from pgkit import files, run
from pgkit.cli.main import main
from pgkit.errors import UserError
from pgkit.run import directory
from pgkit.run.config import write_json


class Bomb:
    """Unpickled, it makes a file."""

    def __init__(self, crater: Path) -> None:
        self.crater = crater

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.crater),)


def hashed(content: bytes) -> bytes:
    return content + b"pgkit-sha256" + hashlib.sha256(content).digest()


def bombs(crater: Path) -> list[bytes]:
    """The bomb as a pickle, as torch saves it, and with the hash that fits."""
    file = io.BytesIO()
    torch.save({"frames": 20, "states": Bomb(crater)}, file)
    plain = [pickle.dumps(Bomb(crater)), file.getvalue()]
    return [*plain, *map(hashed, plain)]


@pytest.fixture
def trained(kit: SimpleNamespace, tmp_path: Path) -> Path:
    kit.train(arguments(kit, tmp_path / "r"))
    return tmp_path / "r"


def arguments(kit: SimpleNamespace, path: Path, total: int = 20, **settings: Any) -> Any:
    return kit.Args(env_id="Fake/Count-v0", run_dir=path, total_frames=total, eval_every=10, **settings)


def uses(kit: SimpleNamespace, path: Path) -> list[Any]:
    """Everything that reads a run directory."""
    return [
        lambda: run.load_policy(path, "best", agent=kit.agent),
        lambda: run.load_agent(path, "latest", agent=kit.agent),
        lambda: run.plot([path], path.parent / "x.png"),
        lambda: kit.train(arguments(kit, path, total=40, resume=path)),
        lambda: kit.train(arguments(kit, path.parent / "tuned", init=path)),
        lambda: kit.train(arguments(kit, path)),
    ]


def outcomes(kit: SimpleNamespace, path: Path, *which: int) -> list[str]:
    """What each use says; an error that is no UserError ends the test."""
    said = []
    for use in [use for number, use in enumerate(uses(kit, path)) if number in which or not which]:
        shutil.rmtree(path.parent / "tuned", ignore_errors=True)
        try:
            use()
        except UserError as error:
            said.append(str(error))
            assert "\n" not in str(error)
        else:
            said.append("")
    return said


@pytest.mark.fault(
    kind=13,
    injected="a pickled bomb in place of any file of a run directory, also with a fitting hash",
    outcome="no command runs it: resume, eval, init, load, plot",
)
def test_a_bomb_in_any_file_runs_in_no_command(kit: SimpleNamespace, trained: Path, tmp_path: Path):
    names = [path.relative_to(trained) for path in trained.rglob("*") if path.is_file()]
    assert {"config.json", "metrics.csv", "latest.pt", "best.pt", "summary.json"} <= {name.name for name in names}
    crater = tmp_path / "crater"
    for number, bomb in enumerate(bombs(crater)):
        for name in names:
            copy = tmp_path / f"{number}-{name.name}" / "r"
            shutil.copytree(trained, copy)
            (copy / name).write_bytes(bomb)
            outcomes(kit, copy, *((0, 1, 2, 3, 4, 5) if number == 3 else (1, 3)))
            with pytest.raises(SystemExit):
                main(["eval", str(copy)])
            assert not crater.exists(), name
    pickle.loads(bombs(crater)[0])
    assert crater.exists()  # the bomb is one


@pytest.mark.fault(
    kind=13,
    injected="`config.json` names someone else's recipe file, module or wrapper",
    outcome="nothing is imported without `--trust`; one line, exit code 2",
)
def test_code_that_a_config_names_is_not_run(kit: SimpleNamespace, trained: Path, tmp_path: Path, monkeypatch: Any):
    evil = tmp_path / "evil.py"
    evil.write_text(f"import os\nos.mkdir({str(tmp_path / 'crater')!r})\n")
    monkeypatch.chdir(tmp_path)
    config = json.loads((trained / "config.json").read_text())
    settings = config["settings"]
    for change in (
        {"file": str(evil)},
        {"file": None, "recipe": str(evil)},
        {"file": None, "recipe": "../evil"},
        {"file": None, "recipe": "ppo", "settings": settings | {"env_id": "evil:X-v0"}},
        {"file": None, "recipe": "ppo", "settings": settings | {"wrapper": "evil:wrap", "trust": True}},
    ):
        write_json(trained / "config.json", {k: v for k, v in (config | change).items() if k != "sha256"})
        for words in (["eval", str(trained)], ["run", "ppo", "--resume", str(trained), "--total-frames", "40"]):
            with pytest.raises(SystemExit) as exit_:
                main(words)
            assert exit_.value.code == 2
        with pytest.raises(UserError):
            run.load_agent(trained)
    assert not (tmp_path / "crater").exists()


@pytest.mark.fault(
    kind=14,
    injected="60 single flipped bits in `latest.pt`",
    outcome="each is found by the hash; the checkpoint that is whole is offered",
)
def test_every_flipped_bit_is_found_and_the_checkpoint_that_is_whole_is_offered(kit: SimpleNamespace, trained: Path):
    path = trained / "checkpoints" / "latest.pt"
    whole, draw = path.read_bytes(), random.Random(0)
    for _ in range(60):
        bit = draw.randrange(8 * len(whole))
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(UserError, match=r"latest.pt is damaged.*best.pt is whole: --resume \S+best.pt, --which"):
            run.load_agent(trained, "latest", agent=kit.agent)
    kit.train(arguments(kit, trained, total=40, resume=path.with_name("best.pt")))
    assert run.load_policy(trained, "latest", agent=kit.agent).frames == 40


@pytest.mark.fault(
    kind=14,
    injected="60 single flipped bits in `config.json` and in `metrics.csv`",
    outcome="a resume finds each",
)
@pytest.mark.parametrize("name", ["config.json", "metrics.csv"])
def test_a_flipped_bit_of_a_text_file_is_found_by_a_resume(kit: SimpleNamespace, trained: Path, name: str):
    path = trained / name
    whole, draw = path.read_bytes(), random.Random(0)
    for _ in range(60):
        bit = draw.randrange(8 * len(whole))
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(UserError):
            kit.train(arguments(kit, trained, total=40, resume=trained))


WRONG = (None, 3, "x", [], {}, [[]], float("inf"), True)


@pytest.mark.fault(
    kind=14,
    injected="every entry of `config.json`, `metrics.csv` and checkpoints as None, a number, a list, text",
    outcome="one line, never a traceback",
)
def test_every_wrong_structure_is_one_line(kit: SimpleNamespace, trained: Path, monkeypatch: Any):
    monkeypatch.setattr(run.run, "evaluate", lambda *_: {"eval/mean_reward": 0.0, "eval/std_reward": 0.0})
    monkeypatch.setattr(run.run, "plot", lambda *_: None)
    original = (trained / "config.json").read_bytes()
    config = {key: value for key, value in json.loads(original).items() if key != "sha256"}
    for key in config:
        for wrong in WRONG:
            write_json(trained / "config.json", config | {key: wrong})
            outcomes(kit, trained, *((0, 1, 2, 5) if wrong == 3 else (0, 5)))
    for name in config["settings"]:
        for wrong in WRONG:
            settings = config["settings"] | {name: wrong}
            write_json(trained / "config.json", {**config, "settings": settings})
            outcomes(kit, trained, 0)
            with pytest.raises(UserError):
                kit.train(arguments(kit, trained, resume=trained))  # damage, or already trained
    (trained / "config.json").write_text("[" * 100_000)
    assert all("config.json cannot be read" in said for said in outcomes(kit, trained)[:4])
    (trained / "config.json").write_bytes(original)
    for rows in (b"\xff\xfe", b"a,b\n1,2\n", b"frames\nx\n", b"frames,train/x\n1,y\n", b'frames\n"'):
        (trained / "metrics.csv").write_bytes(rows)
        said = outcomes(kit, trained)
        assert "metrics.csv" in said[2] and "metrics.csv is damaged" in said[3], rows
    checkpoint = trained / "checkpoints" / "latest.pt"
    saved = files.load(checkpoint)
    (trained / "metrics.csv").unlink()
    for key in saved:
        for wrong in WRONG:
            files.save(checkpoint, saved | {key: wrong})
            outcomes(kit, trained, 1, 3)
    for key in saved["counters"]:
        files.save(checkpoint, saved | {"counters": {k: v for k, v in saved["counters"].items() if k != key}})
        outcomes(kit, trained, 3)


def test_files_come_back_as_they_were(tmp_path: Path):
    content = {
        "array": np.arange(6, dtype=np.int64).reshape(2, 3), "flags": np.array([True, False]), "one": np.float64(0.1),
        "empty": np.zeros((0, 2), np.float32), ("a", 1): [1, (2.0, None)], "words": np.arange(3, dtype=np.uint32),
        "rollout": TensorDict({"next": TensorDict({"reward": torch.ones(2, 3, 1)}, [2, 3])}, [2, 3]),
        "shape": torch.Size([2]), "state": torch.get_rng_state(),
    }  # fmt: skip
    files.save(tmp_path / "x", content)
    back = files.load(tmp_path / "x")
    for name in ("array", "flags", "empty", "words"):
        np.testing.assert_array_equal(back[name], content[name])
        assert back[name].dtype == content[name].dtype
    assert back["one"] == 0.1 and back["a", 1] == [1, (2.0, None)] and back["shape"] == torch.Size([2])
    assert (back["rollout"] == content["rollout"]).all() and torch.equal(back["state"], content["state"])
    with pytest.raises(UserError, match="x, own, part holds <object object"):
        files.save(tmp_path / "x", {"own": {"part": object()}})
    assert files.load(tmp_path / "x")["one"] == 0.1


@pytest.mark.fault(
    kind=17,
    injected="links to another file under the names that are written",
    outcome="the links are replaced; what they led to stays",
)
def test_a_planted_link_is_not_followed(trained: Path, tmp_path: Path):
    (tmp_path / "precious").write_text("mine")
    for name in ("x", ".x.part"):
        (tmp_path / name).symlink_to(tmp_path / "precious")
    files.save(tmp_path / "x", {"a": 1})
    assert (tmp_path / "precious").read_text() == "mine" and files.load(tmp_path / "x") == {"a": 1}
    assert not (tmp_path / "x").is_symlink() and not (tmp_path / ".x.part").exists()


@pytest.mark.fault(
    kind=16,
    injected="a start that fails in a folder with other TensorBoard files and notes",
    outcome="they stay; only what the run made goes",
)
def test_a_failed_start_deletes_its_own_files_alone(kit: SimpleNamespace, tmp_path: Path):
    others = ["events.out.tfevents.1.host.2.0", "notes.txt", ".latest.pt.part"]
    for name in others:
        (tmp_path / name).write_text("mine")
    with pytest.raises(ZeroDivisionError), run.Run(arguments(kit, tmp_path), "walk") as log:
        log.track(policy=kit.policy(), eval_env=kit.Env)
        _ = 1 / 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)


@pytest.mark.fault(
    kind=18,
    injected="a run that was killed before its first checkpoint",
    outcome="the same command starts over; other settings are refused",
)
def test_a_run_killed_before_its_first_checkpoint_begins_again_by_the_same_command(
    kit: SimpleNamespace, trained: Path, tmp_path: Path
):
    shutil.rmtree(trained / "checkpoints")  # as after a kill: settings, some rows, no checkpoint
    (trained / "mine.txt").write_text("")
    with pytest.raises(UserError, match="already holds a run: give another --run-dir, or delete it"):
        kit.train(arguments(kit, trained, seed=5))
    held = directory.lock(trained)
    with pytest.raises(UserError, match="another process goes on with this run"):
        kit.train(arguments(kit, trained))
    directory.unlock(held)
    kit.train(arguments(kit, trained))
    assert (trained / "checkpoints" / "latest.pt").exists() and (trained / "mine.txt").exists()
    assert len(list(trained.glob("events.out.tfevents.*"))) == 1
    kit.train(arguments(kit, tmp_path / "other"))
    assert [line.split(",")[0] for line in (trained / "metrics.csv").read_text().splitlines()] == ["frames", "10", "20"]


@pytest.mark.fault(
    kind=18,
    injected="one command, started again and again with `--resume-if-possible`",
    outcome="it begins, goes on, and ends with code 0 where nothing is left",
)
def test_one_command_goes_on_until_there_is_nothing_left(kit: SimpleNamespace, tmp_path: Path, capsys: Any):
    for total, frames in ((10, 10), (20, 20)):
        kit.train(arguments(kit, tmp_path / "r", total=total, resume_if_possible=True))
        assert run.load_policy(tmp_path / "r", "latest", agent=kit.agent).frames == frames
    with pytest.raises(SystemExit) as exit_:
        kit.train(arguments(kit, tmp_path / "r", resume_if_possible=True))
    assert (
        exit_.value.code == 0
        and "has already trained 20 frames: there is nothing left to do" in capsys.readouterr().out
    )


@pytest.mark.fault(
    kind=19,
    injected="a resume while another process still writes the checkpoint",
    outcome="it is refused before it reads anything",
)
def test_a_resume_locks_before_it_reads(kit: SimpleNamespace, trained: Path):
    held = directory.lock(trained)
    (trained / "checkpoints" / "latest.pt").write_bytes(b"half of what the other process writes")
    with pytest.raises(UserError, match="another process goes on with this run"):
        kit.train(arguments(kit, trained, total=40, resume=trained))
    directory.unlock(held)
    with pytest.raises(UserError, match="latest.pt is damaged"):
        kit.train(arguments(kit, trained, total=40, resume=trained))
    directory.unlock(directory.lock(trained))  # the failed one has given it back


def full(*_: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.fault(
    kind=20,
    injected="a full disk for some checkpoints, and for all",
    outcome="training goes on with a warning; the last one that fails is one line; no half file stays",
)
def test_a_full_disk_stops_no_training_and_leaves_no_half_file(
    kit: SimpleNamespace, tmp_path: Path, monkeypatch: Any, caplog: Any
):
    def fill(frames: int) -> None:
        monkeypatch.setattr(os, "fsync", full if frames < 20 else fsync)

    fsync = os.fsync
    kit.train(arguments(kit, tmp_path / "r", total=30), hook=fill)
    assert re.search(r"(best|latest).pt cannot be written: No space left on device; the training goes on", caplog.text)
    assert run.load_policy(tmp_path / "r", "latest", agent=kit.agent).frames == 30
    assert len((tmp_path / "r" / "metrics.csv").read_text().splitlines()) == 4
    with pytest.raises(UserError, match="cannot be written: No space left on device"):
        kit.train(arguments(kit, tmp_path / "s", total=30), hook=lambda _: monkeypatch.setattr(os, "fsync", full))
    assert not [path for path in (tmp_path / "s").rglob("*") if path.name.endswith(".part")]


@pytest.mark.fault(
    kind=20, injected="a limit amid a file (ulimit -f), as a full disk", outcome="one line, the old file stays"
)
def test_a_write_that_fails_amid_a_file_leaves_the_old_one(tmp_path: Path):
    files.save(tmp_path / "x", {"a": 1})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(UserError, match="x cannot be written: File too large"):
            files.save(tmp_path / "x", {"a": torch.zeros(100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert files.load(tmp_path / "x") == {"a": 1} and [path.name for path in tmp_path.iterdir()] == ["x"]


@pytest.mark.fault(
    kind=20,
    injected="a run directory that is deleted under way",
    outcome="it is said at once; training goes on, and the end is one line",
)
def test_a_directory_that_goes_away_is_said_at_once_and_ends_the_run(kit: SimpleNamespace, tmp_path: Path, caplog: Any):
    def remove(frames: int) -> None:
        if frames == 10:
            shutil.rmtree(tmp_path / "r")

    with pytest.raises(UserError, match="cannot be written: No such file or directory"):
        kit.train(arguments(kit, tmp_path / "r", total=30), hook=remove)
    assert "metrics.csv cannot be written: No such file or directory; the training goes on" in caplog.text


@pytest.mark.fault(
    kind=15,
    injected="a plain number of the actor that is annealed",
    outcome="a loaded policy has its last value",
)
def test_what_is_evaluated_is_what_was_trained_annealed_numbers_included(kit: SimpleNamespace, tmp_path: Path):
    args = arguments(kit, tmp_path / "r")
    with run.Run(args, "walk") as log:
        agent = run.Agent(Scaled())
        log.track(agent=agent, eval_env=kit.Env)
        agent.actor.scale = 0.25  # no buffer, no parameter
        log.step(20)

    def make(args: Any, env: Any) -> run.Agent:
        return run.Agent(Scaled())

    make.__annotations__["args"] = kit.Args
    assert run.load_policy(tmp_path / "r", agent=make).actor.scale == 0.25


class Scaled(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.scale = 1.0

    def forward(self, batch: TensorDict) -> TensorDict:
        return batch.set("action", batch["observation"][..., :1] * self.scale)


def test_an_agent_is_loaded_whole_and_trained_on(kit: SimpleNamespace, tmp_path: Path):
    def make(args: Any, env: Any) -> run.Agent:
        actor = kit.policy(1.0)
        return run.Agent(actor, critic=torch.nn.Linear(2, 1))

    make.__annotations__["args"] = kit.Args
    with run.Run(arguments(kit, tmp_path / "r"), "walk") as log:
        agent = make(None, None)
        log.track(agent=agent, eval_env=kit.Env)
        torch.nn.init.constant_(agent.critic.weight, 3.0)
        log.step(20)
    loaded = run.load_agent(tmp_path / "r", agent=make)
    assert loaded.critic.weight.tolist() == [[3.0, 3.0]] and loaded.actor.module.weight.tolist() == [[1.0, 1.0]]
    with run.Run(arguments(kit, tmp_path / "tuned", init=tmp_path / "r"), "walk") as log:
        fresh = make(None, None)
        log.track(agent=fresh, eval_env=kit.Env)
        assert torch.equal(fresh.critic.weight, agent.critic.weight)
    with pytest.raises(UserError, match=r"state of agent does not fit .*it holds actor, critic; this agent has actor"):
        run.load_agent(tmp_path / "r", agent=kit.agent)


@contextlib.contextmanager
def limited(kind: int, most: int) -> Iterator[None]:
    """What ``ulimit`` does to a process."""
    soft, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(kind, (soft, hard))


@pytest.mark.fault(
    kind=20,
    injected="`ulimit -f`: files of 2 kB at most, and none at all; a file where the run directory's parent should be",
    outcome="one line that says what cannot be written and why; no half file stays",
)
def test_limits_of_the_system_are_one_line(kit: SimpleNamespace, tmp_path: Path):
    for most in (2000, 0):
        with limited(resource.RLIMIT_FSIZE, most), pytest.raises(UserError, match="cannot be written: File too large"):
            kit.train(arguments(kit, tmp_path / str(most)))
        assert not [path for path in tmp_path.rglob("*") if path.name.endswith(".part")]
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "r", tmp_path / "file"):
        with pytest.raises(UserError, match="file"):
            kit.train(arguments(kit, path))
