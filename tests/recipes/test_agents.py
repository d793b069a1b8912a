"""What a recipe trains is built from its settings and loaded from a run directory, without code in its files."""

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit import envs, files, run
from pgkit.cli import recipes
from pgkit.errors import UserError
from pgkit.run.args import told
from tests.recipes.test_ppo import pgkit, rows

DISCRETE, PIXELS = ("dqn", "rainbow", "discrete_sac"), ("drq", "sac_ae")
KINDS = [
    *((name, {}) for name in recipes.names() if name not in ("grpo", "mappo")),  # whose environments are others
    ("ppo", {"recurrent": "gru"}),
    ("sac", {"critic": "simba", "value_head": "categorical"}),
    ("sac", {"critic": "crossq", "value_head": "quantile"}),
    ("sac", {"critic": "droq", "alpha": 0.1}),
]


@pytest.fixture(autouse=True)
def same_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.mark.parametrize(("name", "settings"), KINDS)
def test_an_agent_is_built_again_and_loaded(tmp_path: Path, name: str, settings: dict[str, Any]):
    recipe = recipes.load(recipes.find(name))
    env_id = "CartPole-v1" if name in DISCRETE else "InvertedPendulum-v5" if name in PIXELS else "Pendulum-v1"
    sizes = {"actor_width": 8, "critic_width": 8} if name == "flash_sac" else {"hidden": (8, 8)}
    args = recipe.Args(env_id=env_id, **sizes, **settings)
    env = args.make_env(num_envs=3, seed=1)
    trained, fresh = recipe.agent(args, env), recipe.agent(args, env)
    files.save(tmp_path / "agent", trained.state_dict())
    observed = env.reset()
    if "recurrent" in settings:
        observed["is_init"] = torch.ones(3, 1, dtype=torch.bool)
        observed["recurrent_state"] = torch.zeros(3, args.memory_size)

    def act(agent: run.Agent) -> torch.Tensor:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            outputs = agent.actor.eval()(observed.clone())
        return outputs["action_value" if name in ("dqn", "rainbow") else "action"].float()

    if name != "discrete_sac":  # of two actions, two policies may choose the same three times
        assert not torch.equal(act(trained), act(fresh))
    fresh.load_state_dict(files.load(tmp_path / "agent"))
    assert torch.equal(act(trained), act(fresh))
    for mine, theirs in zip(trained.loss.state_dict().values(), fresh.loss.state_dict().values(), strict=True):
        assert not torch.is_tensor(mine) or torch.equal(mine, theirs)
    env.close()


class Picture(gym.Env):
    observation_space, action_space = gym.spaces.Box(0, 255, (96, 96, 3), np.uint8), gym.spaces.Discrete(2)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("dqn", r"\(96, 96, 3\), its channels come last"),
        ("rainbow", r"rainbow reads vectors, an observation of 'CartPole-v1' is \[96, 96, 3\]"),
    ],
)
def test_a_picture_that_cannot_be_read(name: str, said: str):
    recipe = recipes.load(recipes.find(name))
    with pytest.raises(UserError, match=said):
        recipe.agent(recipe.Args(), envs.make(Picture))


@pytest.mark.parametrize("name", recipes.names())
def test_a_recipe_is_short_and_its_settings_say_what_they_may_be(name: str):
    file = recipes.find(name)
    assert len(file.read_text().splitlines()) <= 220
    settings = recipes.load(file).Args
    for setting, bounds in {
        "total_frames": {"low": 1, "high": 10**15, "on_resume": True},  # those of RunArgs, under another default
        "gamma": {"low": 0, "high": 1},
        "anneal": {"follows": "total_frames"},
        "log_every": {"low": 1, "on_resume": True},
    }.items():
        assert told(settings, setting) == (bounds if setting in settings.__dataclass_fields__ else {})


def test_a_trained_run_is_loaded_evaluated_and_begun_with(tmp_path: Path):
    small = ["--batch-size", 32, "--hidden", 16, "--threads", 1, "--compile", "off", "--eval-episodes", 1]
    flags = ["--env-id", "Pendulum-v1", "--env.g", "9.0", "--env.max-episode-steps", 50, "--random-frames", 100]
    pgkit("run", "td3", *flags, *small, "--total-frames", 200, "--device", "auto", "--run-dir", tmp_path / "r")
    assert json.loads((tmp_path / "r" / "config.json").read_text())["settings"]["env"] == {
        "g": 9.0,
        "max_episode_steps": 50,
    }
    assert {row["eval/mean_ep_length"] for row in rows(tmp_path / "r")} <= {"50.0", ""}
    done = pgkit("eval", tmp_path / "r", "--episodes", 2)
    assert "mean_ep_length   50.00" in done.stdout
    policy, agent = run.load_policy(tmp_path / "r", "latest"), run.load_agent(tmp_path / "r", "latest")
    observation = np.array([1.0, 0.0, 0.0], np.float32)
    assert policy.predict(observation).shape == (1,)
    for mine, theirs in zip(policy.actor.parameters(), agent.actor.parameters(), strict=True):
        assert torch.equal(mine, theirs)
    saved = files.load(tmp_path / "r" / "checkpoints" / "latest.pt")["states"]
    assert torch.equal(agent.loss.state_dict()["gamma"], saved["update"]["loss"]["gamma"])
    others = ["--gamma", 0.5, "--exploration-noise", 0.25]  # settings are the new run's
    tuned = ["--total-frames", 112, "--updates-per-step", 0, "--init", tmp_path / "r", "--run-dir", tmp_path / "tuned"]
    pgkit("run", "td3", *flags, *small, *others, *tuned)  # nothing is trained
    begun, learned = run.load_agent(tmp_path / "tuned"), agent.loss.state_dict()
    assert begun.explorer.std == 0.25 and agent.explorer.std == pytest.approx(0.1)
    for name, mine in begun.loss.state_dict().items():
        assert not torch.is_tensor(mine) or torch.equal(mine, torch.tensor(0.5) if name == "gamma" else learned[name])
    done = pgkit("run", "ddpg", *flags, *small, *tuned[:-1], tmp_path / "other", ok=False)
    assert done.returncode == 2 and "the state of agent does not fit" in done.stderr
    assert not (tmp_path / "other").exists()
