"""The MAPPO recipe: one agent is PPO, resume, compiled code, agents that are gone, two groups, mistakes."""

import json
import sys
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch

from pgkit import collectors, envs, modules, run, updates
from pgkit.cli import recipes
from pgkit.errors import UserError
from pgkit.run.metrics import finished_episodes
from tests.envs.test_agents import Fading, Unlike
from tests.recipes.test_ppo import pgkit, rows

SOLO = """
import gymnasium as gym
from pettingzoo import ParallelEnv

class Solo(ParallelEnv):
    metadata = {"name": "solo"}
    possible_agents = ["agent_0"]

    def __init__(self):
        self.env = gym.make("Pendulum-v1")

    def observation_space(self, agent):
        return self.env.observation_space

    def action_space(self, agent):
        return self.env.action_space

    def reset(self, seed=None, options=None):
        self.agents = ["agent_0"]
        return tuple({"agent_0": x} for x in self.env.reset(seed=seed))

    def step(self, actions):
        result = self.env.step(actions["agent_0"])
        if result[2] or result[3]:
            self.agents = []
        return tuple({"agent_0": x} for x in result)
"""


@pytest.fixture
def solo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "solo_pendulum.py").write_text(SOLO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return "solo_pendulum:Solo"


PLAIN = (
    "--total-frames", 1600, "--num-envs", 4, "--steps", 100, "--epochs", 2, "--minibatch-size", 100,
    "--eval-every", 800, "--eval-episodes", 2, "--hidden", 8, 8, "--compile", "off",
    "--max-grad-norm", 0.5, "--critic-coeff", 0.5, "--learning-rate", 1e-3, "--gamma", 0.95,
)  # fmt: skip


def test_one_agent_is_ppo_bit_for_bit(solo: str, tmp_path: Path):
    ppo = ("--log-std", -0.5, "--no-anneal", "--no-recompute-advantage", "--normalize-advantage", "rollout")
    pgkit("run", "ppo", "--env-id", "Pendulum-v1", *PLAIN, *ppo, "--normalize-obs", "--run-dir", tmp_path / "ppo")
    for name in ("ippo", "mappo"):
        pgkit("run", name, "--env-id", solo, *PLAIN, "--normalize-obs", "--run-dir", tmp_path / name)
        assert rows(tmp_path / name) == rows(tmp_path / "ppo")
    assert len(rows(tmp_path / "ppo")) == 4


@pytest.mark.parametrize(
    "flags", [("vmas/balance", "--env.max_episode_steps", 30), ("mpe2/simple_speaker_listener_v4",)]
)
def test_a_resumed_run_equals_the_straight_one(flags: Any, tmp_path: Path):
    given = ("--env-id", *flags, *PLAIN, "--steps", 25, "--epochs", 1)
    pgkit("run", "mappo", *given, "--run-dir", tmp_path / "straight")
    pgkit("run", "mappo", *given, "--total-frames", 800, "--run-dir", tmp_path / "resumed")
    pgkit("run", "mappo", "--resume", tmp_path / "resumed", "--total-frames", 1600)
    assert rows(tmp_path / "straight") == rows(tmp_path / "resumed")


def test_an_evaluation_in_between_changes_nothing(tmp_path: Path):
    given = ("--env-id", "vmas/balance", "--env.max_episode_steps", 30, *PLAIN, "--steps", 25, "--epochs", 1)
    pgkit("run", "mappo", *given, "--run-dir", tmp_path / "often")
    pgkit("run", "mappo", *given, "--eval-every", 0, "--run-dir", tmp_path / "once")
    trained = [
        [{k: x for k, x in row.items() if not k.startswith("eval/")} for row in rows(tmp_path / name)]
        for name in ("often", "once")
    ]
    assert trained[0][-1] == trained[1][-1] and len(trained[0]) >= len(trained[1])


@pytest.mark.parametrize(
    "flags",
    [
        ("mappo", "--env-id", "vmas/balance", "--env.n_agents", 3, "--agent-ids", "--normalize-advantage", "agent"),
        ("ippo", "--env-id", "mpe2/simple_spread_v3", "--no-share-parameters", "--steps", 25, "--normalize-obs"),
        ("mappo", "--env-id", "mpe2/simple_spread_v3", "--env.continuous_actions", "True", "--workers", 2),
    ],
)
def test_runs_for_a_few_hundred_frames(tmp_path: Path, flags: Any):
    small = ("--num-envs", 8, "--total-frames", 400, "--eval-episodes", 2, "--eval-every", 0, "--compile", "off")
    pgkit("run", *flags, *small, "--run-dir", tmp_path / "run")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["frames"] == 400 and summary["eval/mean_reward"] < 100
    assert "mean_reward" in pgkit("eval", tmp_path / "run", "--episodes", 2).stdout


def test_a_run_of_groups_is_drawn_plotted_and_loaded(tmp_path: Path):
    small = ("--num-envs", 4, "--total-frames", 200, "--steps", 25, "--eval-episodes", 2, "--compile", "off")
    pgkit("run", "mappo", "--env-id", "mpe2/simple_adversary_v3", *small, "--run-dir", tmp_path / "run")
    said = pgkit("eval", tmp_path / "run", "--episodes", 1, "--video", tmp_path / "out.gif").stdout
    frames = imageio.mimread(tmp_path / "out.gif")
    assert "out.gif" in said and len(frames) >= 25 and (frames[0] != frames[10]).any()
    pgkit("plot", tmp_path / "run", "--out", tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1_000
    policy = run.load_policy(tmp_path / "run")
    made = policy.predict({key[0]: np.zeros(shape, np.float32) for key, shape in policy.shapes.items()})
    assert {name: x.shape for name, x in made.items()} == {"adversary": (1,), "agent": (2,)}


def built(make: Any, frames: int = 64, **settings: Any) -> Any:
    torch.manual_seed(0)
    recipe = recipes.load(recipes.find("mappo"))
    env = envs.make(make, num_envs=4, seed=1)
    agent = recipe.agent(recipe.Args(hidden=(8,), **settings), env)
    rollout = collectors.VectorCollector(env, agent.actor, frames_per_batch=frames, compile="off").rollout()
    return env, agent, rollout


def trained(agent: run.Agent, rollout: Any, compile: str = "off", epochs: int = 2) -> tuple[dict[str, float], Any]:
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3)
    update = updates.OnPolicyUpdate(
        agent.loss, agent.advantage, optimizer, epochs=epochs, minibatch_size=16, compile=compile, seed=0
    )
    return update(rollout.clone()), [p.detach().clone() for p in agent.parameters()]


@pytest.mark.parametrize("make", [Fading, Unlike])
def test_what_agents_that_are_gone_leave_in_a_rollout_changes_nothing(make: Any):
    _, agent, rollout = built(make, critic="decentralized", scale_returns=False)
    other = rollout.clone()
    for group in [key for key in ("agents", "speaker", "listener") if key in rollout.keys()]:
        gone = ~rollout[group, "mask"]
        assert gone.any() == (group != "listener")
        for entry in ("observation", "action_log_prob"):
            other[group, entry][gone] = 3.0
        other["next", group, "reward"][gone] = 7.0
    metrics, weights = trained(agent, rollout)
    _, twin, _ = built(make, critic="decentralized", scale_returns=False)
    found, theirs = trained(twin, other)
    assert all(torch.equal(a, b) for a, b in zip(weights, theirs, strict=True))
    assert metrics == found


def test_two_groups_are_trained_as_two_agents_would_be():
    env, agent, rollout = built(Unlike, critic="decentralized", max_grad_norm=1e9)
    recipe = recipes.load(recipes.find("mappo"))
    alone = [
        recipe.group_agent(recipe.Args(hidden=(8,), critic="decentralized"), env, g) for g in ("speaker", "listener")
    ]
    ours, theirs = [*agent.actor.module, *agent.critic], [*(x.actor for x in alone), *(x.critic for x in alone)]
    for one, twin in zip(ours, theirs, strict=True):
        twin.load_state_dict(one.state_dict())

    def gradients(one: run.Agent) -> dict[str, Any]:
        out = one.loss(one.advantage(rollout.clone()).reshape(-1))
        sum(x for key, x in out.items() if key.startswith("loss_")).backward()
        return {"out": out, "grads": [p.grad for p in [*one.loss.parameters()]]}

    both, apart = gradients(agent), [gradients(one) for one in alone]
    assert both["out"]["loss_objective"].item() == apart[0]["out"]["loss_objective"].item()
    assert both["out"]["loss_objective_2"].item() == apart[1]["out"]["loss_objective"].item()
    grads = [*apart[0]["grads"], *apart[1]["grads"]]
    assert all(torch.equal(a, b) for a, b in zip(both["grads"], grads, strict=True))


@pytest.mark.parametrize("make", [Fading, Unlike])
def test_a_compiled_update_equals_the_eager_one(make: Any):
    results = []
    for compile in ("off", "on"):
        _, agent, rollout = built(make)
        results.append(trained(agent, rollout, compile, epochs=1))
    (eager, weights), (native, theirs) = results
    for a, b in zip(weights, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
    assert eager.keys() == native.keys()
    assert eager["loss_objective"] == pytest.approx(native["loss_objective"], rel=1e-3, abs=1e-5)


def test_the_critic_learns_scaled_returns_and_the_advantage_is_in_the_rewards_unit():
    _, agent, rollout = built(Fading, normalize_advantage="off")
    scale = agent.scale["agents"]
    scale.var.fill_(100.0)
    out = agent.advantage(rollout.clone())
    critic = out["agents", "state_value"] * scale.scale
    torch.testing.assert_close(out["agents", "value_target"] * scale.scale, out["agents", "advantage"] + critic)
    reward, done = (out["next", "agents", name][..., 0].double() for name in ("reward", "terminated"))
    last = out["agents", "advantage"][:, 3, 1, 0]  # cut off: the value of the final observation counts
    with torch.no_grad():
        final = env_value(agent, rollout)[:, 3, 1] * scale.scale
    expected = reward[:, 3, 1] + 0.99 * final * (1 - done[:, 3, 1]) - critic[:, 3, 1, 0]
    torch.testing.assert_close(last.double(), expected.double(), rtol=1e-5, atol=1e-5)


def env_value(agent: run.Agent, rollout: Any) -> torch.Tensor:
    """The critic's output for the next observations, ``[N, T, A]``."""
    return agent.critic(rollout["next"].select(("agents", "observation")))["agents", "state_value"][..., 0]


def test_mistakes_are_one_line(tmp_path: Path):
    with pytest.raises(UserError, match="CartPole-v1 has one agent and no group: pgkit run ppo"):
        built("CartPole-v1")
    env = envs.make(Fading, num_envs=2)
    with pytest.raises(UserError, match="each agent's own, in the group 'agents': centralized=True"):
        modules.state_value(env, centralized=("agents", "observation"))
    with pytest.raises(UserError, match="no group 'walkers', only agents"):
        modules.gaussian_actor(env, group="walkers")


class Uneven(Unlike):
    """A speaker, which is paid 0 or 2, and two listeners, who are paid -1."""

    possible_agents = ["speaker_0", "listener_0", "listener_1"]

    def step(self, actions: dict[str, Any]) -> Any:
        seen, reward, *ends = super().step(actions)
        return seen, {x: 2.0 if x == "speaker_0" else -1.0 for x in reward}, *ends


def test_the_evaluated_return_is_the_mean_over_all_agents_of_all_groups():
    _, agent, rollout = built(Uneven)
    returns, lengths = run.play(agent.actor, envs.make(Uneven, num_envs=2), episodes=2)
    mean = (2 * 2.0 - 4.0 - 4.0) / 3  # the speaker dies after 2 steps, each listener goes on for 4
    assert lengths.tolist() == [4, 4] and returns.tolist() == pytest.approx([mean, mean])
    assert finished_episodes(rollout) == [(pytest.approx(mean), 4)] * 16
