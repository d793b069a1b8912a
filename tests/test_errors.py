"""Wrong arguments are answered at once, with one line that says what to give."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

from pgkit import advantages, collectors, controllers, data, envs, losses, modules, updates
from pgkit.envs.spaces import action_spec, observation_entries
from pgkit.errors import UserError, check_whole_number, within

ENV = envs.make("Pendulum-v1")
ACTOR, CRITIC = modules.gaussian_actor(ENV, (8,)), modules.state_value(ENV, (8,))
ADAM = torch.optim.Adam([*ACTOR.parameters(), *CRITIC.parameters()])
PPO = partial(updates.OnPolicyUpdate, losses.ClipPPOLoss(ACTOR, CRITIC), advantages.GAE(CRITIC))
SAC = partial(losses.SACLoss, modules.tanh_normal_actor(ENV, (8,)), modules.q_value(ENV, 2, (8,)))
REPLAYED = partial(updates.OffPolicyUpdate, SAC(), data.ReplayBuffer(ENV, 2000), ADAM)


class WithANumber(nn.Module):
    alpha = 0.2

    def loss(self, log_prob):
        return log_prob


STORED = ENV.rollout(4).exclude("action_log_prob")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: PPO(ADAM, epochs=0), "epochs=0: give a whole number, at least 1"),
        (lambda: PPO(ADAM, minibatch_size=32.0), "minibatch_size=32.0: give a whole number"),
        (lambda: PPO(ADAM, epochs=np.int64(0)), "epochs=.*0.*: give a whole number, at least 1"),
        (lambda: modules.discrete_q_value(envs.make("CartPole-v1"), 0), "num_critics=0"),
        (lambda: PPO(ADAM, target_kl=-1), "target_kl=-1: give a number that is at least 0"),
        (lambda: PPO(ADAM, compile=False), "compile is 'auto', 'on' or 'off', not False"),
        (lambda: PPO([ADAM, ADAM]), "several optimizers are one block: updates.Together"),
        (lambda: PPO(torch.optim.Adam), "optimizer is a type: give torch.optim.Adam"),
        (lambda: PPO(torch.optim.LBFGS(ACTOR.parameters())), "LBFGS evaluates the loss several times"),
        (lambda: updates.Together([ADAM, ADAM]), "several optimizers are one block"),
        (lambda: PPO(ADAM, schedules={"lr": 1e-3}, total_frames=9), "'lr' is 0.001, give a function of the progress"),
        (lambda: REPLAYED(tau=5), "tau=5: give a number from 0 to 1"),
        (lambda: REPLAYED(actor_delay=0), "actor_delay=0: give a whole number"),
        (lambda: REPLAYED(updates_per_step=-1), "updates_per_step=-1: give a number that is at least 0"),
        (lambda: updates.OffPolicyUpdate(SAC(), None, ADAM), "draws from a replay buffer, this is a NoneType"),
        (lambda: updates.TrustRegionUpdate(losses.TRPOLoss(ACTOR), None, cg_steps=0), "cg_steps=0"),
        (lambda: advantages.GAE(CRITIC, gamma=2), "gamma=2: give a number from 0 to 1"),
        (lambda: advantages.GAE(CRITIC, lmbda=-1), "lmbda=-1: give a number from 0 to 1"),
        (lambda: advantages.GAE(nn.Linear(3, 1)), "takes a TensorDict module as critic, this is a Linear"),
        (lambda: SAC(gamma=2), "gamma=2: give a number from 0 to 1"),
        (lambda: SAC(temperature=0.2), r"temperature=0.2: give a block .*controllers.FixedTemperature"),
        (lambda: envs.make("Pendulum-v1", seed=-1), "seed=-1: give a whole number, at least 0"),
        (lambda: envs.make("Pendulum-v1", action_repeat=0), "action_repeat=0: give a whole number, at least 1"),
        (lambda: action_spec(gym.spaces.MultiBinary([2, 3]), 1), r"has shape \(2, 3\), actions are vectors: flatten"),
        (lambda: action_spec(gym.spaces.MultiDiscrete([[2, 3], [4, 5]]), 1), r"has shape \(2, 2\), actions are"),
        (
            lambda: observation_entries(gym.spaces.Dict(step_count=gym.spaces.Discrete(2)), flatten=False),
            "'step_count' has a name that rollouts us",
        ),
        (lambda: SAC(temperature=WithANumber()), "WithANumber.alpha is 0.2: make it a tensor of one number"),
        (lambda: SAC(alpha_init=0), "alpha_init=0: give a number above 0"),
        (lambda: controllers.Temperature(-1, 0), "alpha_init=0: give a number above 0"),
        (lambda: losses.ClipPPOLoss(ACTOR, clip_epsilon=-0.2), "clip_epsilon=-0.2: give a number"),
        (lambda: data.Prioritized(alpha=-5), "alpha=-5: give a number"),
        (lambda: data.ReplayBuffer(1000), "env is a int, give what envs.make gives"),
        (lambda: data.ReplayBuffer(ENV, 1e3), "capacity=1000.0: give a whole number"),
        (lambda: data.ReplayBuffer(ENV, 9, sampler="prioritized"), "sampler='prioritized': give data.Prioritized"),
        (lambda: data.ReplayBuffer(ENV, 9).extend(STORED.exclude("next")), "rollout to store has no 'next'"),
        (
            lambda: data.ReplayBuffer(ENV, 9).extend(STORED.exclude("action")),
            "the rollout to store has no 'action', o",
        ),
        (lambda: data.ReplayBuffer(ENV, 9).extend(STORED.exclude(("next", "done"))), "the next to store has no 'done'"),
        (lambda: modules.gaussian_actor(ENV, hidden=64), r"hidden=64: give the sizes of the layers, hidden=\(64,\)"),
        (lambda: modules.q_value(ENV, 2, hidden=64), "hidden=64: give the sizes"),
        (lambda: modules.q_value(ENV, 0), "num_critics=0: give a whole number"),
        (
            lambda: modules.gaussian_actor(gym.make("Pendulum-v1")),
            "a TorchRL environment, this is a TimeLimit",
        ),
        (lambda: modules.gaussian_actor(ENV, encoder=nn.Linear(4, 8)), r"encoder=Linear cannot take .* \(1, 3\): mat1"),
        (lambda: collectors.VectorCollector(ENV, nn.Linear(3, 1), frames_per_batch=8), "as actor, this is a Linear"),
        (lambda: collectors.VectorCollector(ENV, ACTOR, frames_per_batch=8.0), "frames_per_batch=8.0: give a whole"),
    ],
)
def test_a_wrong_argument_is_named(call, message):
    with pytest.raises(UserError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_bounds_are_inclusive_and_none_passes():
    check_whole_number(1, a=1, b=None, c=np.int64(2))
    within(0, 1, a=0, b=1.0, c=torch.tensor(0.5), d=None)
    for low, high, value in ((0, 1, 1.01), (0, 1, float("nan")), (1, float("inf"), 0.5)):
        with pytest.raises(UserError, match="^a="):
            within(low, high, a=value)


@pytest.mark.fault(
    kind=32,
    injected="a second phase with an update of its own, after the first has moved the weights",
    outcome="no warning about another policy; a rollout of another actor gets one",
)
def test_a_batch_of_another_policy_is_said_but_not_of_one_that_an_earlier_phase_has_trained(caplog):
    critic = modules.state_value(ENV, (8,))

    def warns(actor, rollout, lr=0.0):
        caplog.clear()
        loss = losses.ClipPPOLoss(actor, critic)
        optimizer = torch.optim.SGD(loss.parameters(), lr=lr)
        updates.OnPolicyUpdate(loss, advantages.GAE(critic), optimizer, epochs=1, compile="off")(rollout)
        return "is the loss built on the actor that collects?" in caplog.text

    actor, other = modules.gaussian_actor(ENV, (8,)), modules.gaussian_actor(ENV, (8,), log_std=0.0)
    rollout = collectors.VectorCollector(ENV, actor, frames_per_batch=64, compile="off").rollout()
    with torch.no_grad():
        loc = actor(rollout.select("observation"))["loc"]
    assert not warns(actor, rollout, lr=100.0)  # phase one
    with torch.no_grad():
        moved = (actor(rollout.select("observation"))["loc"] - loc).abs().max()
    assert moved > 0.01 and not warns(actor, rollout)  # phase two, with an update of its own
    assert warns(other, rollout)


def test_rows_that_are_as_many_as_features_are_no_broadcast_mistake():
    class Waves(nn.Module):
        frequencies = torch.arange(32.0)

        def forward(self, x):
            return (x[..., :1] * self.frequencies).sin()  # [32, 1] * [32]

    critic = modules.state_value(ENV, encoder=Waves())
    loss = losses.ClipPPOLoss(ACTOR, critic)
    update = updates.OnPolicyUpdate(
        loss, advantages.GAE(critic), torch.optim.SGD(loss.parameters(), lr=0.0), minibatch_size=32, compile="off"
    )
    assert update(collectors.VectorCollector(ENV, ACTOR, frames_per_batch=64, compile="off").rollout())["grad_norm"] > 0
