"""What a loss is asked, and the advice that follows: groups of agents, blocks that are functions, other losses."""

import pytest
import torch
import torchrl.objectives
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from pgkit import advantages, controllers, envs, losses, modules, updates
from pgkit.checks import LossView, assembly, entries
from pgkit.checks.broadcasts import BroadcastError, NoBroadcasts
from pgkit.errors import UserError
from pgkit.updates.minibatches import as_rows
from tests.updates.mistakes import Agent


def test_entries_of_a_group_keep_the_agents_dimension():
    agent = Agent()
    names = {name: ("agents", name) for name in ("advantage", "value_target")}
    agent.loss.set_keys(**names, sample_log_prob=("agents", "action_log_prob"))
    view = LossView(agent.loss)

    def batch(**change):
        group = {"advantage": (4, 3, 1), "value_target": (4, 3, 1), "action_log_prob": (4, 3)} | change
        return TensorDict({"agents": TensorDict({key: torch.zeros(size) for key, size in group.items()}, [4, 3])}, [4])

    entries.check_form(view, batch())
    with pytest.raises(UserError, match=r"'agents.advantage' is \(4, 3\), expected \(4, 3, 1\) by ClipPPOLoss"):
        entries.check_form(view, batch(advantage=(4, 3)))
    with pytest.raises(UserError, match=r"'agents.action_log_prob' is \(4, 3, 1\), expected \(4, 3\) by ClipPPOLoss"):
        entries.check_form(view, batch(action_log_prob=(4, 3, 1)))
    mask = TensorDict({"mask": torch.ones(4, 3, dtype=torch.bool), "other": torch.ones(4, 3)}, [4, 3])
    assert view.readable(TensorDict({"agents": mask}, [4])) == [("agents", "mask")]


def test_one_agent_broadcasts_as_none_does():
    x = torch.zeros(4, 1)
    with NoBroadcasts("Mine"), pytest.raises(BroadcastError, match=r"\(4, 1\) and a \(4, 1, 1\) to \(4, 4, 1\)"):
        x * x.unsqueeze(-1)
    with NoBroadcasts("Mine"):
        assert (x.squeeze(-1) * torch.zeros(3, 1)).shape == (3, 4)  # another size is no slip
        assert (x[:1].squeeze(-1) + x[:1]).shape == (1, 1)


def test_a_function_is_called_by_its_own_name_and_writes_the_advantage():
    agent = Agent()

    def reward_to_come(rollout):
        return agent.advantage(rollout)

    update = updates.OnPolicyUpdate(agent.loss, reward_to_come, torch.optim.Adam(agent.parameters), compile="off")
    rows = {line.split()[0]: line.split()[1:] for line in str(update).splitlines() if line.startswith("  ")}
    assert rows["advantage"] == ["reward_to_come", "ClipPPOLoss"] == rows["value_target"]
    assert "advantage  reward_to_come\n" in str(update) and "function" not in str(update)
    update(agent.rollout)


class Cloning(losses.PolicyLoss):
    """Behaviour cloning: the collected actions become likelier."""

    def forward(self, tensordict):
        return TensorDict({"loss_objective": -self.log_prob(self.distribution(tensordict), tensordict).mean()})

    def _writes(self):
        return ["loss_objective"]


def test_a_loss_that_reads_no_advantage_needs_none_nor_any_order():
    agent = Agent()
    agent.loss, agent.advantage = Cloning(agent.actor), None
    agent.parameters = list(agent.actor.parameters())
    agent.rollout = agent.rollout.exclude("action_log_prob").reshape(-1)[torch.randperm(64)]
    before = agent.loss(agent.rollout)["loss_objective"]
    agent.train()
    assert agent.loss(agent.rollout)["loss_objective"] < before


def test_a_loss_that_would_estimate_on_a_minibatch_is_refused_and_left_without_an_estimator():
    agent = Agent()
    agent.loss, agent.advantage = torchrl.objectives.ClipPPOLoss(agent.actor, agent.critic), None
    with pytest.raises(UserError, match="no 'advantage', which ClipPPOLoss reads; nothing writes it"):
        agent.train()
    assert agent.loss._value_estimator is None


def test_a_trust_region_needs_a_loss_that_measures_it():
    env = envs.make("Pendulum-v1")
    loss = losses.SACLoss(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 2, (8,)))
    with pytest.raises(UserError, match=r"needs a loss with kl\(\) and keep_distribution\(\), SACLoss has none"):
        updates.TrustRegionUpdate(loss, None)


def test_schedules_name_the_coefficients_that_there_are():
    agent = Agent()
    settings = {"schedules": {"entropy": controllers.linear(1, 0)}, "total_frames": 9}
    with pytest.raises(UserError, match=r"ClipPPOLoss has no coefficient 'entropy', only lr, .*entropy_coeff"):
        updates.OnPolicyUpdate(agent.loss, None, torch.optim.Adam(agent.parameters), **settings)


def test_the_look_leaves_statistics_and_random_numbers_alone():
    class Head(nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = nn.Sequential(nn.BatchNorm1d(3), nn.Linear(3, 1))

        def forward(self, x):
            return self.layers(x), torch.ones_like(x[..., :1])

    net = TensorDictModule(Head(), ["observation"], ["loc", "scale"])
    actor = ProbabilisticActor(net, ["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True)
    agent = Agent()
    batch = agent.rollout.reshape(-1).set("advantage", torch.ones(64, 1))
    loss = losses.ClipPPOLoss(actor)
    before, random = {name: x.clone() for name, x in loss.state_dict().items()}, torch.get_rng_state()
    view = LossView(loss)
    view.distribution(batch)
    assembly(view, torch.optim.Adam(loss.parameters()), batch)
    assert all(torch.equal(x, before[name]) for name, x in loss.state_dict().items())
    assert torch.equal(random, torch.get_rng_state()) and before


def test_the_memory_of_a_group_wants_sequences_too():
    group = TensorDict({"recurrent_state": torch.zeros(2, 8, 3, 4)}, [2, 8, 3])
    with pytest.raises(UserError, match="the networks are recurrent"):
        as_rows(TensorDict({"agents": group}, [2, 8]), None)
    assert as_rows(TensorDict({"agents": group}, [2, 8]), 4)["agents"].batch_size == (4, 4, 3)


def test_who_estimates_is_not_asked_of_a_critic_alone():
    agent = Agent()
    view = LossView(agent.loss, advantages.GAE(agent.critic))
    assert view.writer("advantage") == "GAE" and view.writer("action") == "actor_network"
    assert view.writer(("next", "reward")) == "environment"
    assert view.lacks_advantage(agent.rollout) and not view.lacks_advantage(agent.advantage(agent.rollout))
