import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pgkit.cli import recipes
from pgkit.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
RECIPE = '''"""Walks at random, with an env of its own."""

from dataclasses import dataclass
from functools import partial

import gymnasium as gym
import numpy as np
import torch
from tensordict.nn import TensorDictModule

from pgkit import envs, run


class Env(gym.Env):
    observation_space, action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None): return np.zeros(2, np.float32), {}
    def step(self, action): return np.zeros(2, np.float32), 7.0, True, False, {}


@dataclass
class Args(run.RunArgs):
    width: int = 2
    """How wide."""

    def make_env(self, num_envs, seed, workers=1):
        return envs.make(Env, num_envs, seed=seed)


class Net(torch.nn.Linear):
    """A class that exists in this file alone."""


def agent(args: Args, env):
    return run.Agent(TensorDictModule(Net(args.width, 1), ["observation"], ["action"]))


def main(args):
    with run.Run(args, recipe="walk") as log:
        log.track(agent=agent(args, None), eval_env=args.make_env)
        for frames in range(log.frames + 10, args.total_frames + 1, 10):
            log.step(frames)


if __name__ == "__main__":
    run.launch(main, Args, {"CartPole-v1": {"total_frames": 20}})
'''


SAY = '''"""Say."""
from dataclasses import dataclass

from pgkit import run

VARIANTS = {"loud": dict(seed=2, tone="a")}


@dataclass
class Args(run.RunArgs):
    variant: str = ""
    tone: str = "b"


def main(args):
    raise SystemExit(f"{__name__} {args.variant} {args.seed} {args.tone}")
'''


def pgkit(*words: str, cwd: Path, **environ: str) -> subprocess.CompletedProcess[str]:
    """The installed script, which Python does not look for modules beside: ``python -P``."""
    code = "from pgkit.cli.main import main; main()"
    command = [sys.executable, "-P", "-W", "error", "-c", code, *words]
    environ = os.environ | {"PYTHONPATH": str(ROOT)} | environ
    return subprocess.run(command, cwd=cwd, env=environ, capture_output=True, text=True)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recipe ``walk.py`` and its run ``r``, made by the command line."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "walk.py").write_text(RECIPE)
    done = pgkit("run", "walk.py", "--run-dir", "r", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "pgkit run walk.py --resume r --total-frames 40" in done.stdout
    return folder


@pytest.fixture
def inside(trained: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder as the working directory of this process."""
    monkeypatch.chdir(trained)
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    return trained


def fail(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as exit_:
        main(words)
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    return error


@pytest.mark.fault(
    kind=29,
    injected="`pgkit eval` of a run of a recipe file",
    outcome="it runs that file only with `--trust`",
)
def test_eval_runs_a_recipe_file_only_where_it_is_trusted(inside: Path, capsys: pytest.CaptureFixture[str], caplog):
    words = ["eval", "r", "--episodes", "3", "--which", "latest"]
    assert f"r is a run of {inside / 'walk.py'}, which would be run: --trust" in fail(capsys, *words)
    main([*words, "--trust"])
    out = capsys.readouterr().out
    assert "3 episodes" in out and "mean_reward      7.00" in out and not caplog.text
    (inside / "walk.py").write_text(RECIPE + "\n")
    main([*words, "--trust"])
    assert "walk.py has changed since the run" in caplog.text
    (inside / "walk.py").unlink()
    assert "which is not there" in fail(capsys, *words, "--trust")
    (inside / "walk.py").write_text(RECIPE)


def test_a_user_error_in_a_recipe_is_one_line_and_exit_2(trained: Path):
    done = pgkit("run", "walk.py", "--run-dir", "r", cwd=trained)
    assert done.returncode == 2
    assert done.stderr.startswith("error: r already holds a run") and done.stderr.count("\n") == 1


def test_a_run_goes_on_by_the_command_it_printed(inside: Path):
    assert json.loads(Path("r/summary.json").read_text())["frames"] == 20
    main(["run", "walk.py", "--resume", "r", "--total-frames", "40"])
    frames = [line.split(",")[0] for line in Path("r/metrics.csv").read_text().splitlines()]
    assert frames == ["frames", "10", "20", "30", "40"]


def test_plot(inside: Path, capsys: pytest.CaptureFixture[str]):
    for name, written in (("both.svg", "both.svg"), ("noext", "noext.png")):
        main(["plot", "r", "r", "-o", name])
        assert Path(written).exists() and capsys.readouterr().out == f"wrote {written}\n"


def test_flags_reach_the_recipe(inside: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as exit_:
        main(["run", "walk.py", "--help"])
    assert not exit_.value.code
    out = capsys.readouterr().out
    assert "--width" in out and "How wide." in out and "Walks at random" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "walk.py", "--resume", "r", "--total-frames", "10"], "already trained"),
        (["run", "walk.py", "--eval-episodes", "0"], "--eval-episodes 0: give at least 1"),
        (["run", "nothing.py"], "no recipe file nothing.py"),
        (["run", "walk"], "no recipe named walk; the file here is walk.py"),
        (["cp", "ppo", "mine.txt"], "give one that ends in .py"),
        (["eval", "."], "not a run directory"),
        (["plot", "."], "not a run directory"),
        (["run", "walk.py", "--run-dir", "x" * 300], "File name too long"),
        (["run", "walk.py", "--resume", "x" * 300], "is not a run directory"),
        (["cp", "ppo", "x" * 300 + ".py"], "cannot be written: File name too long"),
        (["plot", "r", "-o", "x" * 300 + ".png"], "File name too long"),
        (["eval", "x" * 300], "is not a run directory"),
        (["run", "ppo", "--env-id", "MiniGrid-Empty-5x5-v0"], "registers it: minigrid:MiniGrid-Empty-5x5-v0"),
        (["run", "walk.py", "--threads", "1e6"], "--threads 1000000: give at most 256"),
        (["run", "walk.py", "--num-envs", str(2**63)], "--num-envs 9223372036854775808: give at most 1e+06"),
        (["run", "walk.py", "--resume-if-possible"], "--resume-if-possible needs a --run-dir"),
    ],
)
def test_user_errors(inside: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str):
    assert message in fail(capsys, *words)


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two shipped recipes."""
    (tmp_path / "shelf").mkdir()
    (tmp_path / "shelf/ppo.py").write_text('"""Proximal policy optimization.\n\nMore."""\nraise SystemExit("ran")\n')
    (tmp_path / "shelf/sac.py").write_text('"""Soft actor-critic."""\n')
    monkeypatch.setattr(recipes, "recipes_dir", lambda: tmp_path / "shelf")
    return tmp_path


def test_ls_shows_first_lines_and_runs_nothing(shelf: Path, capsys: pytest.CaptureFixture[str]):
    main(["ls"])
    assert capsys.readouterr().out.splitlines() == [
        "ppo          Proximal policy optimization.",
        "sac          Soft actor-critic.",
    ]


def test_variants_are_listed_with_their_settings_run_and_copied(shelf: Path, inside: Path, capsys, monkeypatch):
    (shelf / "shelf/say.py").write_text(SAY)
    main(["ls"])
    assert "loud         say --seed 2 --tone a" in capsys.readouterr().out.splitlines()
    with pytest.raises(SystemExit) as exit_:
        main(["run", "loud", "--seed", "3"])
    assert exit_.value.code == "say loud 3 a"
    main(["cp", "loud", str(shelf / "mine.py")])
    assert capsys.readouterr().out.endswith("mine.py --variant loud\n")
    assert "nearest: loud" in fail(capsys, "run", "loudd")


def test_cp_copies_and_never_overwrites(shelf: Path, capsys: pytest.CaptureFixture[str]):
    target = shelf / "mine.py"
    main(["cp", "ppo", str(target)])
    assert target.read_text() == (shelf / "shelf/ppo.py").read_text()
    target.write_text("edited")
    assert "not overwritten" in fail(capsys, "cp", "ppo", str(target))
    assert target.read_text() == "edited"
    assert "no directory" in fail(capsys, "cp", "ppo", str(shelf / "no/mine.py"))


def test_a_recipe_is_imported_and_hides_no_module(shelf: Path, inside: Path, capsys: pytest.CaptureFixture[str]):
    before = sys.modules["__main__"], sys.modules["queue"], [*sys.path]
    (shelf / "shelf/queue.py").write_text(SAY)
    with pytest.raises(SystemExit) as exit_:
        main(["run", "queue", "--seed", "3"])
    assert exit_.value.code == "queue_recipe  3 b"
    assert (sys.modules["__main__"], sys.modules["queue"], sys.path[: len(before[2])]) == before
    (shelf / "shelf/half.py").write_text('"""Half a recipe."""\ndef main(args): ...\n')
    assert "half.py has no Args: a recipe has a class Args and a function main(args)" in fail(capsys, "run", "half")


def test_an_unknown_recipe_names_the_nearest(shelf: Path, capsys: pytest.CaptureFixture[str]):
    assert "no recipe named ppoo; nearest: ppo (" in fail(capsys, "run", "ppoo")
    assert "nearest: ppo, sac (" in fail(capsys, "cp", "xyz", "x.py")


def test_usage_errors(capsys: pytest.CaptureFixture[str]):
    assert "invalid choice" in fail(capsys, "bogus")
    assert "recipe" in fail(capsys, "run")
    assert "0 is not a positive number" in fail(capsys, "eval", "r", "--episodes", "0")


def test_recipes_are_found_in_a_checkout_and_in_a_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert recipes.recipes_dir() == ROOT / "recipes"
    (tmp_path / "pgkit/cli").mkdir(parents=True)
    (tmp_path / "pgkit/recipes").mkdir()
    monkeypatch.setattr(recipes, "__file__", str(tmp_path / "pgkit/cli/recipes.py"))
    assert recipes.recipes_dir() == tmp_path / "pgkit/recipes"


def test_ls_and_help_import_nothing_heavy():
    code = (
        "import sys; from pgkit.cli.main import main; main(['ls']); "
        "print({'torch', 'matplotlib', 'tensorboard', 'gymnasium', 'tyro'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


def test_names_in_the_working_directory_hide_nothing_and_any_terminal_does(trained: Path, tmp_path: Path):
    for folder in (tmp_path, tmp_path / "pandas", tmp_path / "torch"):
        folder.mkdir(exist_ok=True)
        (folder / "__init__.py").write_text("raise SystemExit('the wrong module')\n")
    (tmp_path / "queue.py").write_text("raise SystemExit('the wrong module')\n")
    (tmp_path / "walk.py").write_text(RECIPE)
    done = pgkit("run", "walk.py", "--run-dir", "r", cwd=tmp_path, PYTHONIOENCODING="ascii", LC_ALL="C")
    assert done.returncode == 0, done.stderr
    assert "eval 7.0 ? 0.0" in done.stdout  # a plus-minus that this terminal does not have


def test_an_error_in_the_user_s_code_is_one_line_and_the_user_s_own_frames(tmp_path: Path):
    (tmp_path / "walk.py").write_text(
        RECIPE.replace("log.step(frames)", "log.step(frames)\n            _ = 1 / (20 - frames)")
    )
    done = pgkit("run", "walk.py", "--run-dir", "r", "--total-frames", "40", cwd=tmp_path)
    assert done.returncode == 1
    saved, line, *frames = done.stderr.splitlines()
    assert saved == "the run ends at an error; r has the checkpoint of 20 frames"
    assert line == "error: ZeroDivisionError: division by zero"
    assert len(frames) >= 2 and "_ = 1 / (20 - frames)" in done.stderr
    assert "run.py" not in done.stderr and "site-packages" not in done.stderr and "Traceback" not in done.stderr


def test_an_error_in_pgkit_or_below_shows_every_frame(tmp_path: Path):
    (tmp_path / "walk.py").write_text(RECIPE.replace("log.step(frames)", "log.step(frames, None, 3)"))
    done = pgkit("run", "walk.py", "--run-dir", "r", "--total-frames", "40", cwd=tmp_path)
    assert done.returncode == 1 and "error: " in done.stderr
    assert "metrics.py" in done.stderr and "walk.py" in done.stderr


def test_a_reader_that_goes_away_is_no_error(trained: Path):
    code = "from pgkit.cli.main import main; main(['ls'])"
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as ls:
        assert ls.stdout and ls.stderr
        ls.stdout.close()
        assert ls.stderr.read() == b""
    assert ls.returncode == 141


@pytest.mark.fault(
    kind=2,
    injected="a recipe whose training diverges",
    outcome="exit code 3, one line",
)
def test_a_diverged_run_exits_with_3(tmp_path: Path):
    (tmp_path / "walk.py").write_text(RECIPE.replace("log.step(frames)", "log.step(frames, None, {'x': float('nan')})"))
    done = pgkit("run", "walk.py", "--run-dir", "r", "--total-frames", "20", cwd=tmp_path)
    assert done.returncode == 3
    assert done.stderr.splitlines()[-1].startswith("error: the training has diverged: train/x is not finite")
