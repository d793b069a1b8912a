"""DrQ and SAC-AE as a user runs them, and the other recipes on images: a stand-in of 20x20 and 36x36 pixels."""

import json

import numpy as np
import pytest
import torch
from torchrl.objectives import SoftUpdate

from pgkit import envs, modules, run
from pgkit.cli import recipes
from tests.recipes import stand_ins
from tests.recipes.test_ppo import pgkit, rows

OFF_POLICY = ("--random-frames", 32, "--batch-size", 8, "--log-every", 32, "--hidden", 16, "--save-buffer")


def train(name, run_dir, *argv, frames=96, env_id="Bar-v0", ok=True, compile="off"):
    flags = ["--env-id", env_id, "--eval-every", 48, "--eval-episodes", 1, "--threads", 1, "--compile", compile]
    return pgkit("run", name, *flags, "--total-frames", frames, "--run-dir", run_dir, *argv, ok=ok)


def continuous(name, run_dir, *argv, **kwargs):
    own = ("--pixels", 0, "--action-repeat", 1, "--frame-stack", 2)
    return train(name, run_dir, *own, *OFF_POLICY, *argv, **kwargs)


@pytest.mark.parametrize("name", ["drq", "sac_ae"])
def test_resumed_with_its_buffer_it_equals_the_straight_run_and_the_same_seed_the_same(tmp_path, name):
    continuous(name, tmp_path / "straight")
    continuous(name, tmp_path / "again")
    continuous(name, tmp_path / "resumed", frames=48)
    pgkit("run", name, "--resume", tmp_path / "resumed", "--total-frames", 96)
    straight = rows(tmp_path / "straight")
    assert straight == rows(tmp_path / "again") == rows(tmp_path / "resumed")
    assert straight[-1]["train/loss_qvalue"] and straight[-1]["eval/mean_reward"]
    assert ("train/loss_reconstruction" in straight[-1]) == (name == "sac_ae")


@pytest.mark.slow
def test_compiled_in_one_graph_drq_equals_the_eager_run(tmp_path):
    continuous("drq", tmp_path / "eager", frames=80)
    continuous("drq", tmp_path / "compiled", frames=80, compile="on")
    for eager, compiled in zip(rows(tmp_path / "eager"), rows(tmp_path / "compiled"), strict=True):
        for key in ("train/loss_qvalue", "train/loss_actor", "train/grad_norm"):
            if eager[key]:
                assert float(compiled[key]) == pytest.approx(float(eager[key]), rel=0.02, abs=1e-3), key


@pytest.mark.parametrize(
    ("name", "flags"),
    [
        ("ppo", ("--num-envs", 2, "--steps", 32, "--epochs", 2)),
        ("dqn", (*OFF_POLICY, "--num-envs", 2)),
        ("discrete_sac", (*OFF_POLICY, "--num-envs", 2, "--updates-per-step", 0.25)),
    ],
)
def test_images_with_discrete_actions(tmp_path, name, flags):
    env_id = "tests.recipes.stand_ins:DiscreteBar-v0"
    train(name, tmp_path / "a", *flags, env_id=env_id)
    train(name, tmp_path / "b", *flags, "--workers", 2, env_id=env_id)
    assert rows(tmp_path / "a") == rows(tmp_path / "b")  # one process or two
    assert rows(tmp_path / "a")[-1]["train/grad_norm"]
    policy = run.load_policy(tmp_path / "a", trust=True)
    assert policy.predict(np.zeros((1, 1, 36, 36), np.uint8)).shape == (1,)


def test_the_score_of_an_evaluation_is_the_games_while_training_sees_clipped_rewards(tmp_path):
    flags = ("--env.reward-clipping", "True", "--num-envs", 1, "--steps", 32, "--epochs", 1, "--env.scale", 100.0)
    train("ppo", tmp_path / "run", *flags, frames=64, env_id="DiscreteBar-v0")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["eval/mean_reward"] > 12
    assert float(rows(tmp_path / "run")[-1]["rollout/ep_rew_mean"]) > 12  # twelve steps of rewards up to 1


def agent_of(name, **settings):
    recipe = recipes.load(recipes.find(name))
    args = recipe.Args(env_id="Bar-v0", pixels=0, frame_stack=2, action_repeat=1, hidden=(8,), **settings)
    env = args.make_env(1, 1)
    torch.manual_seed(0)
    return recipe.agent(args, env), env


def frames(env):
    env.reset()
    steps = [env.rand_step(env.reset()) for _ in range(6)]
    return torch.stack([step.squeeze(0) for step in steps])


@pytest.mark.parametrize("name", ["drq", "sac_ae"])
def test_the_actors_losses_leave_the_convolutions_as_they_are(name):
    built, env = agent_of(name)
    batch = frames(env)
    batch = modules.random_shift(2, copies=2)(batch) if name == "drq" else batch
    SoftUpdate(built.loss, tau=0.1)  # or TorchRL warns that nobody moves the targets
    out = built.loss(batch)
    convolutions = list(built.critic.module.encoder.convolutions.parameters())
    grads = {
        key: torch.autograd.grad(out[key], convolutions, retain_graph=True, allow_unused=True)
        for key in out.keys()
        if key.startswith("loss_") and out[key].requires_grad
    }
    trains = {key for key, found in grads.items() if any(g is not None and g.any() for g in found)}
    assert trains == {"loss_qvalue"} | ({"loss_reconstruction"} if name == "sac_ae" else set())


def test_the_recipes_say_what_they_cannot_read(tmp_path):
    error = continuous("drq", tmp_path / "a", env_id="Pendulum-v1", ok=False).stderr
    assert "no image" in error
    own = ("--pixels", 0, "--action-repeat", 1, "--frame-stack", 3, "--buffer-size", 2)
    error = train("drq", tmp_path / "b", *own, *OFF_POLICY, ok=False).stderr
    assert "a stack of 3 frames ('observation') is longer than the 2 steps" in error
    shown = envs.make(lambda: stand_ins.Bar(size=40, render_mode="rgb_array"), pixels=20, frame_stack=2)
    assert modules.conv_encoder(shown).shape == (6, 20, 20)
