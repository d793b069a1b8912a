"""``pgkit eval --video``: what is in the file, and one line for what is missing."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest

from pgkit import modules, run
from pgkit.cli.main import main
from pgkit.errors import UserError
from pgkit.run import video


class Clock(gym.Env):
    """Episodes of three steps; an image's brightness is the step's number times 60."""

    observation_space, action_space = gym.spaces.Box(-1, 1, (2,), np.float32), gym.spaces.Discrete(2)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None, works: bool = True) -> None:
        self.render_mode, self.works, self.t = render_mode, works, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.t = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return np.zeros(2, np.float32), 2.0, self.t == 3, False, {}

    def render(self) -> Any:
        if not self.works:
            raise RuntimeError("no display name")
        return np.full((32, 32, 3), 60 * self.t, np.uint8)


gym.register("tests/Clock-v0", Clock)


@pytest.fixture
def policy() -> run.Policy:
    args = run.RunArgs(env_id="tests/Clock-v0", env_timeout=60.0)
    env = args.make_env(1, 0)
    return run.Policy(modules.categorical_actor(env), args.make_env, **run.policy.describe_env(env), args=args)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio leaves its reader's pipes open
@pytest.mark.parametrize("name", ["out.mp4", "out.gif"])
def test_every_frame_of_every_episode(policy: run.Policy, tmp_path: Path, name: str):
    scores, file = video.record(policy, tmp_path / name, episodes=2)
    assert scores == {"eval/mean_reward": 6.0, "eval/std_reward": 0.0, "eval/mean_ep_length": 3.0}
    assert file == tmp_path / name
    brightness = [float(np.asarray(frame)[..., :3].mean()) for frame in imageio.mimread(file)]
    np.testing.assert_allclose(brightness, [0, 60, 120, 180, 0, 60, 120, 180, 0][: len(brightness)], atol=6)
    assert len(brightness) >= 8


def test_a_gif_where_there_is_no_codec(policy: run.Policy, tmp_path: Path, monkeypatch: Any, caplog: Any):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert video.record(policy, tmp_path / "out.mp4", 1)[1] == tmp_path / "out.gif"
    assert "needs imageio_ffmpeg" in caplog.text and (tmp_path / "out.gif").stat().st_size > 0


def test_what_is_missing_is_one_line(policy: run.Policy, tmp_path: Path, monkeypatch: Any):
    assert policy.args is not None
    policy.args.env["works"] = False
    with pytest.raises(UserError, match=r"cannot be rendered \(no display name\).*MUJOCO_GL=egl"):
        video.record(policy, tmp_path / "out.gif", 1)
    with pytest.raises(UserError, match="ends in .mp4 or .gif"):
        video.record(policy, tmp_path / "out.avi", 1)
    with pytest.raises(UserError, match="no directory"):
        video.record(policy, tmp_path / "missing" / "out.gif", 1)
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    with pytest.raises(UserError, match=r'needs imageio.v2: pip install "pgkit-rl\[video\]"'):
        video.record(policy, tmp_path / "out.gif", 1)
    assert not list(tmp_path.iterdir())


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    sizes = ["--total-frames", "64", "--num-envs", "2", "--steps", "32", "--eval-episodes", "1", "--compile", "off"]
    main(["run", "ppo", "--env-id", "tests/Clock-v0", *sizes, "--run-dir", str(tmp_path / "run")])
    main(["eval", str(tmp_path / "run"), "--episodes", "2", "--video", str(tmp_path / "out.gif")])
    out = capsys.readouterr().out
    assert "mean_reward      6.00" in out and f"wrote {tmp_path / 'out.gif'}" in out
