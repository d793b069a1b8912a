"""The command line and the import path: whatever is typed gives one line, and nothing in a folder breaks a run."""

import contextlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pgkit.cli.main import main

PPO = ["run", "ppo", "--env-id", "CartPole-v1", "--num-envs", "2", "--steps", "16", "--total-frames", "32"]
PPO += ["--eval-episodes", "1", "--compile", "off"]
MINE = """
import gymnasium as gym, numpy as np

class Mine(gym.Env):
    observation_space, action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(2)
    def __init__(self, size, shape=(2,)):
        kind = np.uint8 if len(shape) > 1 else np.float32
        self.t, self.observation_space = 0, gym.spaces.Box(0, 255, tuple(shape), kind)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observation_space.sample(), {}
    def step(self, action):
        self.t += 1
        return self.observation_space.sample(), 1.0, self.t == 5, False, {"is_success": True}

if "Mine-v0" not in gym.registry:
    gym.register("Mine-v0", entry_point="mine:Mine")
def none(env): pass
def two(env, k): return env
number = 3
"""


def typed(*words: Any) -> tuple[int, str]:
    """Exit code and all that was printed; an exception that is no exit ends the test."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            main([str(word) for word in words])
        except SystemExit as end:
            return int(end.code or 0), out.getvalue()
    return 0, out.getvalue()


def refused(*words: Any) -> str:
    """The one line that refuses it."""
    code, text = typed(*words)
    lines = [line for line in text.splitlines() if not line.startswith(("preset", "variant"))]
    assert code == 2 and len(lines) == 1 and lines[0].startswith("error: "), text
    return lines[0].removeprefix("error: ")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    known = [*sys.meta_path]
    yield tmp_path
    sys.meta_path[:] = known
    sys.modules.pop("mine", None)


@pytest.mark.fault(
    kind=27,
    injected="a folder `pandas`, files `queue.py`, `random.py`, `torch.py` and others in the working directory",
    outcome="none of them is imported, in any command",
)
def test_files_in_the_working_directory_hide_no_module(tmp_path: Path):
    bomb = "open('crater', 'w').close()\nraise SystemExit('imported')\n"
    for name in ("queue", "random", "torch", "numpy", "yaml", "typing_extensions", "gymnasium", "ppo", "secrets"):
        (tmp_path / f"{name}.py").write_text(bomb)
    (tmp_path / "pandas").mkdir()
    (tmp_path / "pandas" / "__init__.py").write_text(bomb)
    program = "import sys; from pgkit.cli.main import main; main(sys.argv[1:])"
    env = {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(x for x in sys.path if x)}
    done = subprocess.run(
        [sys.executable, "-c", program, *PPO, "--run-dir", "r"], cwd=tmp_path, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0 and not (tmp_path / "crater").exists(), done.stderr


@pytest.mark.fault(
    kind=28,
    injected="wrappers by import path that are missing, no functions, take two arguments, or return nothing",
    outcome="one line says what the wrapper must be",
)
def test_wrappers(here: Path):
    for wrapper, message in {
        "mine:none": "--wrapper mine:none returned None: return the wrapped environment",
        "mine:two": "--wrapper mine:two is called with one environment, this cannot be: missing a required",
        "mine:nope": "--wrapper mine:nope: the module has no 'nope'",
        "mine:number": "--wrapper mine:number: it is no function",
        "mine": "--wrapper mine: give module:function",
        "nowhere:wrap": "--wrapper nowhere:wrap: no module 'nowhere'",
    }.items():
        assert message in refused(*PPO, "--wrapper", wrapper)
    assert not (here / "runs").exists()


@pytest.mark.fault(
    kind=28,
    injected="ids whose environment needs an argument, of plugins that need an import, with a typing error",
    outcome="one line says how: `--env.KEYWORD VALUE`, `minigrid:MiniGrid-Empty-5x5-v0`, the nearest names",
)
def test_ids(here: Path):
    missing = "missing 1 required positional argument: 'size'; --env.KEYWORD VALUE"
    for env_id, message in {
        "mine:Mine": missing,
        "mine:Mine-v0": missing,
        "MiniGrid-Empty-5x5-v0": "where a package registers it: minigrid:MiniGrid-Empty-5x5-v0",
        "highway-v0": "where a package registers it: highway_env:highway-v0",
        "minigrid_of_nobody:X-v0": "no module 'minigrid_of_nobody' to import, neither here nor installed (pip install",
        "CartPol-v1": "the nearest names are CartPole-v1",
        "x" * 3000: "unknown environment id 'xxx",
        "": "",
        "a\nb": "",
    }.items():
        assert message in refused(*PPO[:2], "--env-id", env_id, *PPO[4:])
    unknown = refused(*PPO, "--env.speed", "3")
    assert "cannot be made with these settings" in unknown and "unexpected keyword argument 'speed'" in unknown
    for name in ("num_envs", "seed", "workers", "action-repeat"):
        assert "the run gives that to the environment" in refused(*PPO, f"--env.{name}", "3")
    code, text = typed(*PPO[:2], "--env-id", "mine:Mine-v0", *PPO[4:], "--env.size", 3, "--env.info", "is_success",
                       "--run-dir", "r")  # fmt: skip
    assert code == 0, text
    assert "rollout/success_rate" in (here / "r" / "metrics.csv").read_text()


@pytest.mark.fault(
    kind=30,
    injected="observations of every shape in `dqn`, `rainbow` and `ppo`; replays of 400 GB and more",
    outcome="it trains, or one line names the shape, or the sizes in GB, before anything is allocated",
)
def test_shapes_and_sizes(here: Path):
    env = ["--env-id", "mine:Mine", "--env.size", 1, "--env.shape"]
    end = ["--num-envs", 2, "--total-frames", 1040, "--eval-episodes", 1, "--compile", "off"]
    for recipe in ("dqn", "rainbow"):
        code, text = typed("run", recipe, *env, "(5,5)", *end, "--random-frames", 1000, "--run-dir", recipe)
        assert code == 0, text
        big = refused("run", recipe, *env, "(3,)", *end, "--buffer-size", 10**10)
        assert re.search(r"a replay of 10,000,000,000 frames takes [\d.,]+ GB, .* GB of memory are free", big)
    assert "rainbow reads vectors" in refused("run", "rainbow", *env, "(3,40,40)", *end)
    for recipe in ("dqn", "ppo"):
        assert "its channels come last" in refused("run", recipe, *env, "(40,40,3)", *end)


NUMBERS = ("9223372036854775808", "-9223372036854775809", "1e300", "1e400", "nan", "-1", "x", "")


@pytest.mark.fault(
    kind=31,
    injected="every number flag of `ppo` and `sac` at 2^63, -2^63 - 1, 1e300, 1e400, NaN, -1, a letter and nothing",
    outcome="one line names the flag and its bounds",
)
@pytest.mark.parametrize("recipe", ["ppo", "sac"])
def test_absurd_numbers(recipe: str, here: Path):
    import dataclasses

    from pgkit.cli import recipes
    from pgkit.run.args import told

    args_class = recipes.load(recipes.find(recipe)).Args
    for field in dataclasses.fields(args_class):
        if not isinstance(field.default, int | float | tuple) or isinstance(field.default, bool):
            continue
        flag, bounds = f"--{field.name.replace('_', '-')}", told(args_class, field.name)
        for number in NUMBERS:
            if number == "-1" and not bounds.keys() & {"low", "above"}:
                continue  # a number that may be negative
            if not number and isinstance(field.default, tuple):
                continue
            said = refused("run", recipe, "--total-frames", 32, f"{flag}={number}")
            assert field.name.replace("_", "-") in said, said
    assert not any(here.glob("runs/*"))


@pytest.mark.fault(
    kind=31,
    injected="names of 300 characters, of folders, without or with unknown endings, in folders that are not there",
    outcome="one line says what cannot be written and why; `plot -o noext` becomes `noext.png`",
)
def test_names_of_files(here: Path):
    assert typed(*PPO, "--run-dir", "r")[0] == 0
    assert "wrote noext.png" in typed("plot", "r", "-o", "noext")[1]
    long = "x" * 300
    for words in (
        ("plot", "r", "-o", f"{long}.png"), ("plot", "r", "-o", "a.xyz"), ("plot", "r", "-o", "."),
        ("plot", "r", "-o", "no/such/a.png"), ("plot", long), ("plot", "mine.py"), ("eval", long), ("eval", "mine.py"),
        ("eval", "r", "--video", f"{long}.gif"), ("eval", "r", "--video", "a.xyz"), ("eval", "r", "--video", "a/b.gif"),
        ("eval", "r", "--episodes", 2**63), ("eval", "r", "--episodes", 0), ("eval", "r", "--seed", -1),
        ("eval", "r", "--seed", 2**63), ("export", "r", "-o", long), ("export", "r", "-o", f"{long}.pt2"),
        ("export", "r", "-o", "no/a.pt2"), ("export", "r", "-o", "a.xyz"), ("cp", "ppo", f"{long}.py"),
        ("cp", "ppo", "no/a.py"), ("cp", "nope", "a.py"), ("cp", "ppo", "a"), ("report", "nope.csv"), ("report", "."),
        (*PPO, "--run-dir", long), (*PPO, "--run-dir", "mine.py"), (*PPO, "--run-dir", "r"), 
        (*PPO, "--resume", long), (*PPO, "--init", long), (*PPO, "--resume-if-possible"), (), ("nope",), ("run",),
        ("experiment", "ppo", "--envs", "CartPole-v1", "--seeds", "1-99999999999999"),
        ("experiment", "ppo", "--envs", "CartPole-v1", "--seeds", "5-1"),
        ("experiment", "ppo", "--envs", "CartPole-v1", "--jobs", "99999999999"),
        ("tune", "ppo", "--env-id", "CartPole-v1", "--trials", "-5"),
    ):  # fmt: skip
        refused(*words)
    assert not [path for path in here.iterdir() if len(path.name) > 100 or path.suffix == ".part"]


@pytest.mark.fault(
    kind=31,
    injected="a reader that goes away (`head`), a terminal that knows ASCII only",
    outcome="no traceback; signs that the terminal lacks become `?`",
)
def test_pipes_and_terminals(here: Path):
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(x for x in sys.path if x), "PYTHONUTF8": "0", "LC_ALL": "C"}
    env |= {"PYTHONIOENCODING": "ascii", "PYTHONCOERCECLOCALE": "0"}
    program = f"{sys.executable} -c 'from pgkit.cli.main import main; main()'"
    for words in ("ls | head -1", "run ppo --help | head -1", "run ppo --help > /dev/null"):
        done = subprocess.run(f"{program} {words}", shell=True, env=env, capture_output=True, text=True)
        assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
