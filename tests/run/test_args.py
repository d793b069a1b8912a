import sys
from pathlib import Path

import pytest
import torch

from pgkit.errors import UserError
from pgkit.run import RunArgs, placed

MODULE = """import gymnasium as gym


class Halved(gym.RewardWrapper):
    def reward(self, reward):
        return reward / 2


gym.register("Half-v0", entry_point="gymnasium.envs.classic_control:CartPoleEnv", max_episode_steps=7)
constant = 3
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "my_halves.py").write_text(MODULE)
    (tmp_path / "my_parts.py").write_text("")
    for shadow in ("queue.py", "pandas.py"):
        (tmp_path / shadow).write_text("raise SystemExit('the wrong module')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    return tmp_path


def episode(args: RunArgs, frames: int) -> tuple[list[float], int]:
    """Rewards, and the length of the first episode."""
    env = args.make_env(num_envs=1, seed=0)
    rollout = env.rollout(frames, break_when_any_done=True)
    env.close()
    return rollout["next", "reward"].flatten().tolist(), rollout.shape[1]


def test_keywords_reach_the_environment():
    args = RunArgs(env_id="CartPole-v1", env={"max_episode_steps": 3, "sutton_barto_reward": True})
    assert episode(args, 10) == ([0.0, 0.0, 0.0], 3)  # 0 for every step but the one that falls
    assert RunArgs(env_id="Pendulum-v1", env={"g": 0.0}).make_env(num_envs=1, seed=0).num_envs == 1
    with pytest.raises(UserError, match="Pendulum-v1"):
        RunArgs(env_id="Pendulum-v1", env={"gravity": 0.0}).make_env(num_envs=1, seed=0)


def test_a_wrapper_and_an_id_come_from_the_working_directory_which_hides_nothing(here: Path):
    args = RunArgs(env_id="my_halves:Half-v0", wrapper="my_halves:Halved", action_repeat=2)
    assert args.imports() == ["--env-id my_halves:Half-v0", "--wrapper my_halves:Halved"]
    env = args.make_env(num_envs=1, seed=0)
    assert env.env_id == "my_halves:Half-v0 (action repeat 2)"
    env.close()
    assert episode(args, 10)[0][:3] == [1.0, 1.0, 1.0]  # two steps of reward 1/2
    assert str(here) not in sys.path
    args = RunArgs(env_id="CartPole-v1", wrapper="my_halves:Halved", env={"max_episode_steps": 3})
    assert episode(args, 10) == ([0.5, 0.5, 0.5], 3)


@pytest.mark.parametrize(
    ("wrapper", "message"),
    [
        ("my_halves", "give module:function, as in my_module:wrap"),
        ("no_such:wrap", "no module 'no_such', neither here nor installed"),
        ("my_halves:quarter", "the module has no 'quarter'"),
        ("my_halves:constant", "it is no function"),
    ],
)
def test_a_wrapper_that_cannot_be_meant(here: Path, wrapper: str, message: str):
    with pytest.raises(UserError, match=f"--wrapper {wrapper}: {message}"):
        RunArgs(env_id="CartPole-v1", wrapper=wrapper).make_env(num_envs=1, seed=0)


def test_networks_are_made_on_the_device(monkeypatch: pytest.MonkeyPatch):
    assert placed(RunArgs(device="cpu")) == torch.device("cpu")
    for found, device in ((False, "cpu"), (True, "cuda")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda found=found: found)
        assert placed(RunArgs()) == torch.device(device)
    assert placed(RunArgs(device="cpu")) == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="--device cuda: PyTorch finds no GPU here"):
        placed(RunArgs(device="cuda"))
    with torch.device("meta"):
        assert torch.nn.Linear(1, 1).weight.device.type == "meta"
