"""Ctrl-C inside a loss, which calls networks in ``with params.to_module(...)``, stays Ctrl-C."""

from typing import Any

import pytest
import torch

from pgkit import advantages, collectors, data, envs, losses, modules, updates


@pytest.mark.fault(kind=25, injected="Ctrl-C inside a loss, without a run", outcome="KeyboardInterrupt")
@pytest.mark.parametrize("first", [True, False])  # in the look at the agent before its first step, or later
@pytest.mark.parametrize("off_policy", [True, False])
def test_an_interrupt_inside_a_loss_stays_one(off_policy: bool, first: bool):
    env = envs.make("Pendulum-v1", 2)
    if off_policy:
        actor, critic = modules.tanh_normal_actor(env, (4,)), modules.q_value(env, 2, (4,))
        loss = losses.SACLoss(actor, critic)
        settings: Any = {"batch_size": 4, "learning_starts": 4, "compile": "off"}
        update: Any = updates.OffPolicyUpdate(
            loss, data.ReplayBuffer(env, 100), torch.optim.Adam(loss.parameters()), **settings
        )
        network = loss.qvalue_network
    else:
        actor, critic = modules.gaussian_actor(env, (4,)), modules.state_value(env, (4,))
        loss = losses.ClipPPOLoss(actor, critic)
        optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()])
        update = updates.OnPolicyUpdate(loss, advantages.GAE(critic), optimizer, compile="off")
        network = loss.critic_network
    collector = collectors.VectorCollector(env, actor, frames_per_batch=8, compile="off")
    if not first:
        update(collector.rollout())

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    assert network is not None
    network.register_forward_pre_hook(interrupt)
    with pytest.raises(KeyboardInterrupt):
        update(collector.rollout())
