"""Learning shown in seconds, for each loss and estimator of the family: the action repeats the observation."""

import pytest
import torch

from pgkit import advantages, collectors, controllers, envs, losses, modules, run, updates
from tests.updates.test_identity import Identity


def agent(discrete):
    torch.manual_seed(0)
    env = envs.make(lambda: Identity(discrete), num_envs=8, seed=1)
    build = modules.categorical_actor if discrete else modules.gaussian_actor
    return env, build(env, hidden=(32,)), modules.state_value(env, hidden=(32,))


def learns(env, actor, threshold, frames, train):
    before = run.evaluate(actor, env, 10)["eval/mean_reward"]
    for rollout in collectors.VectorCollector(env, actor, frames_per_batch=256, total_frames=frames, compile="off"):
        train(rollout)
    assert before < threshold - 1 < threshold < run.evaluate(actor, env, 10)["eval/mean_reward"]


def one_step(loss, advantage):
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    return updates.OnPolicyUpdate(loss, advantage, optimizer, epochs=1, minibatch_size=None, compile="off")


def a2c(actor, critic):
    return one_step(losses.A2CLoss(actor, critic), advantages.NStep(critic, gamma=0.5, steps=3, standardize=True))


def impala(actor, critic):
    return one_step(losses.A2CLoss(actor, critic), advantages.VTrace(critic, actor, gamma=0.5, standardize=True))


def reinforce(actor, critic):
    return one_step(
        losses.ReinforceLoss(actor, critic), advantages.MonteCarlo(critic, gamma=0.5, standardize=True)
    )  # fmt: skip


def without_baseline(actor, critic):
    return one_step(losses.ReinforceLoss(actor), advantages.MonteCarlo(gamma=0.0, standardize=True))


def ppo_penalty(actor, critic):
    controller = controllers.AdaptiveKL(0.02)
    loss = losses.KLPENPPOLoss(actor, critic, controller=controller)
    update = updates.OnPolicyUpdate(
        loss, advantages.TDLambda(critic, gamma=0.5), torch.optim.Adam(loss.parameters(), lr=3e-3), compile="off"
    )

    def train(rollout):
        update(loss.keep_distribution(rollout))
        controller.update(loss.kl(rollout))

    return train


def trpo(actor, critic):
    optimizer = torch.optim.Adam(critic.parameters(), lr=3e-3)
    advantage = advantages.GAE(critic, gamma=0.5, average_gae=True)
    return updates.TrustRegionUpdate(losses.TRPOLoss(actor, critic), advantage, optimizer, max_kl=0.05, compile="off")


@pytest.mark.parametrize("build", [a2c, impala, reinforce, without_baseline, ppo_penalty, trpo])
def test_learns_the_identity(build):
    env, actor, critic = agent(discrete=True)
    learns(env, actor, 15.5, 20_480, build(actor, critic))


@pytest.mark.parametrize("build", [ppo_penalty, trpo])
def test_learns_the_identity_of_numbers(build):
    env, actor, critic = agent(discrete=False)
    learns(env, actor, -2.0, 20_480, build(actor, critic))


def test_group_relative_learns_which_action_pays():
    # eight attempts at one task at a time, each of 16 steps: a group is the rollout's eight rows
    env, actor, _ = agent(discrete=True)
    update = one_step(losses.ReinforceLoss(actor), advantages.GroupRelative(8))
    for rollout in collectors.VectorCollector(env, actor, frames_per_batch=128, total_frames=51_200, compile="off"):
        rollout["next", "reward"] = (rollout["action"] == 1).float().unsqueeze(-1)
        update(rollout)
    assert (rollout["action"] == 1).float().mean() > 0.95
