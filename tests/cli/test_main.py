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


@dataclass
class Args(run.RunArgs):
    width: int = 2
    """How wide."""


class Env(gym.Env):
    observation_space, action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None): return np.zeros(2, np.float32), {}
    def step(self, action): return np.zeros(2, np.float32), 7.0, True, False, {}


class Net(torch.nn.Linear):
    """A class that exists in this file alone."""


def main(args):
    with run.Run(args, recipe="walk") as log:
        policy = TensorDictModule(Net(args.width, 1), ["observation"], ["action"])
        log.track(policy=policy, eval_env=partial(envs.make, Env))
        for frames in range(log.frames + 10, args.total_frames + 1, 10):
            log.step(frames)


if __name__ == "__main__":
    run.launch(main, Args, {"CartPole-v1": {"total_frames": 20}})
'''


def pgkit(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    code = "from pgkit.cli.main import main; main()"
    command = [sys.executable, "-W", "error", "-c", code, *words]
    return subprocess.run(command, cwd=cwd, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)


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
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])
    return trained


def fail(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as exit_:
        main(words)
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    return error


def test_eval_needs_no_recipe(trained: Path):
    (trained / "walk.py").rename(trained / "gone")
    try:
        done = pgkit("eval", "r", "--episodes", "3", "--which", "latest", cwd=trained)
    finally:
        (trained / "gone").rename(trained / "walk.py")
    assert done.returncode == 0, done.stderr
    assert "3 episodes" in done.stdout and "mean_reward      7.00" in done.stdout


def test_a_user_error_in_a_recipe_is_one_line_and_exit_2(trained: Path):
    done = pgkit("run", "walk.py", "--run-dir", "r", cwd=trained)
    assert done.returncode == 2
    assert done.stderr.startswith("error: r already holds a run") and done.stderr.count("\n") == 1


def test_a_run_goes_on_by_the_command_it_printed(inside: Path):
    assert json.loads(Path("r/summary.json").read_text())["frames"] == 20
    main(["run", "walk.py", "--resume", "r", "--total-frames", "40"])
    frames = [line.split(",")[0] for line in Path("r/metrics.csv").read_text().splitlines()]
    assert frames == ["frames", "10", "20", "30", "40"]


def test_plot(inside: Path):
    main(["plot", "r", "r", "-o", "both.png"])
    assert Path("both.png").exists()


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
    recipe = (
        '"""Say."""\nVARIANTS = {"loud": dict(num_times=2, tone="a")}\nimport sys\nraise SystemExit((*sys.argv,))\n'
    )
    (shelf / "shelf/say.py").write_text(recipe)
    main(["ls"])
    assert "loud         say --num-times 2 --tone a" in capsys.readouterr().out.splitlines()
    with pytest.raises(SystemExit) as exit_:
        main(["run", "loud", "--seed", "3"])
    assert exit_.value.code == ("loud", "--variant", "loud", "--seed", "3")
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


def test_a_shipped_recipe_is_run_under_the_name_that_was_typed(shelf: Path, inside: Path):
    (shelf / "shelf/say.py").write_text("import sys\nraise SystemExit((__name__, *sys.argv))\n")
    with pytest.raises(SystemExit) as exit_:
        main(["run", "say", "--seed", "3"])
    assert exit_.value.code == ("__main__", "say", "--seed", "3")


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
