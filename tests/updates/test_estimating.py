"""Who writes the advantage, on which rows, and what an epoch measures its changes from."""

import pytest
import torch
import torchrl.objectives
from torchrl.objectives.utils import ValueEstimators

from pgkit import advantages, envs, losses, modules, updates
from pgkit.errors import UserError
from tests.updates.test_on_policy import make_agent, make_rollout, parameters


def test_what_the_block_returns_counts():
    metrics = []
    for of in (lambda rollout: rollout, lambda rollout: rollout.copy()):
        update = make_agent(advantage=None)
        gae = advantages.GAE(update.loss.critic_network)

        def halved(rollout, gae=gae, of=of):
            rollout = of(gae(rollout))
            return rollout.set("advantage", rollout["advantage"] / 2 + 1)

        update.advantage, update.loss.normalize_advantage = halved, False
        metrics.append(update(make_rollout()))
    assert metrics[0] == metrics[1]
    update.advantage = lambda rollout: None
    with pytest.raises(UserError, match="the advantage block <lambda> returned a NoneType: return the rollout"):
        update(make_rollout())


@pytest.mark.parametrize("loss_class", [losses.ClipPPOLoss, torchrl.objectives.ClipPPOLoss])
def test_a_loss_s_own_estimator_sees_the_rollout_and_not_a_minibatch(loss_class):
    results = []
    for by_hand in (True, False):
        update, rollout = make_agent(loss_class=loss_class, advantage=None), make_rollout(rows=(4, 32))
        update.loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
        if by_hand:
            update.loss._value_estimator(rollout, params=update.loss.critic_network_params.detach())
        update(rollout)
        results.append(parameters(update))
    torch.testing.assert_close(*results, rtol=0, atol=1e-5)


def test_a_loss_s_own_estimator_estimates_again_before_each_epoch_if_asked_to():
    results = []
    for again in (True, False):
        update, rollout = make_agent(advantage=None, recompute_advantage=again), make_rollout()
        update.loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
        update(rollout)
        results.append(parameters(update))
    assert "advantage" not in rollout.keys() and not torch.equal(*results)


def test_a_loss_that_would_estimate_on_minibatches_is_refused():
    update = make_agent(loss_class=torchrl.objectives.ClipPPOLoss, advantage=None)
    with pytest.raises(UserError, match="no 'advantage', which ClipPPOLoss reads; nothing writes it"):
        update(make_rollout())


def test_epochs_that_estimate_again_measure_from_the_policy_and_value_before_them():
    seen = []

    class Seen(losses.ClipPPOLoss):
        def forward(self, batch):
            seen.append(batch["state_value"].clone())
            return super().forward(batch)

    update = make_agent(loss_class=Seen, recompute_advantage=True, epochs=3, minibatch_size=None)
    update.loss.clip_value = torch.tensor(0.2)
    update(make_rollout())
    first, *others = (x.sum() for x in seen[-3:])
    assert all(torch.isclose(first, other) for other in others)


def test_a_loss_of_ones_own_reads_what_it_names():
    class Dynamics(losses.ClipPPOLoss):
        def _reads(self):
            return [*super()._reads(), ("next", "observation")]

        def forward(self, batch):
            change = batch["next", "observation"] - batch["observation"]
            return super().forward(batch).set("loss_change", change.square().mean())

    assert make_agent(loss_class=Dynamics)(make_rollout())["loss_change"] > 0


def test_trust_region_updates_refuse_a_flattened_rollout():
    env = envs.make("Pendulum-v1", 4, seed=1)
    actor, critic = modules.gaussian_actor(env), modules.state_value(env)
    optimizer = torch.optim.Adam(critic.parameters())
    update = updates.TrustRegionUpdate(losses.TRPOLoss(actor, critic), advantages.GAE(critic), optimizer)
    with torch.no_grad(), pytest.raises(UserError, match="time last, not flattened"):
        update(env.rollout(8, actor).reshape(-1))


@pytest.mark.parametrize("compile", ["on", "off"])
def test_a_coefficient_that_is_replaced_takes_effect(compile):
    update = make_agent(compile=compile, minibatch_size=None)
    before = update(make_rollout())["loss_entropy"]
    update.loss.entropy_coeff = torch.tensor(0.0)
    assert before != 0 and update(make_rollout())["loss_entropy"] == 0


def test_without_a_graph_settings_of_the_optimizer_may_change_under_way():
    update, twin = (make_agent(compile="off", epochs=1) for _ in range(2))
    for agent in (update, twin):
        agent(make_rollout(0))
    update.optimizer.param_groups[0]["betas"] = (0.5, 0.9)
    for agent in (update, twin):
        agent(make_rollout(1))
    assert not torch.equal(*(torch.cat([p.flatten() for p in agent.loss.parameters()]) for agent in (update, twin)))
    update.optimizer.load_state_dict(update.optimizer.state_dict())
    update(make_rollout(2))
