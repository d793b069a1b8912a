"""Estimators of a group of agents: each agent as if it were alone, root flags for all, masked steps left out."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torchrl.modules import MultiAgentMLP, ProbabilisticActor
from torchrl.objectives.value import MultiAgentGAE

from pgkit import advantages, modules
from pgkit.errors import UserError
from pgkit.functional import standardize
from pgkit.updates.on_policy import CompiledAdvantage

N, T, A = 3, 11, 2


def group_rollout(own_flags=False, own_reward=True):
    """Random steps; an observation leads to the next one, but where an episode, or an agent's, ends."""
    torch.manual_seed(0)

    def flags(*shape):
        done = torch.rand(N, T, *shape, 1) < 0.2
        return {"done": done, "terminated": done & (torch.rand(N, T, *shape, 1) < 0.5)}

    root, own = flags(), flags(A)
    observation, final, reward = torch.randn(N, T, A, 4), torch.randn(N, T, A, 4), torch.randn(N, T, A, 1)
    ended = own["done"] if own_flags else root["done"].unsqueeze(2)
    after = torch.where(ended, final, observation.roll(-1, 1))
    agents = {"observation": after, **(own if own_flags else {}), **({"reward": reward} if own_reward else {})}
    following = {**root, **({} if own_reward else {"reward": reward[:, :, 0]})}
    acted = {
        "observation": observation, "action": torch.randint(3, (N, T, A)), "action_log_prob": torch.randn(N, T, A),
    }  # fmt: skip
    return TensorDict(
        {"agents": TensorDict(acted, [N, T, A]), "next": {**following, "agents": TensorDict(agents, [N, T, A])}}, [N, T]
    )


def agent_alone(rollout, i):
    after = rollout["next"]
    found = {name: after.get(("agents", name), after.get(name, None)) for name in ("reward", "done", "terminated")}
    found = {name: x[:, :, i] if x.dim() == 4 else x for name, x in found.items()}
    own = {name: x[:, :, i] for name, x in rollout["agents"].items()}
    return TensorDict({**own, "next": {"observation": after["agents", "observation"][:, :, i], **found}}, [N, T])


class Rows(torch.nn.Module):
    """Linear, row by row in the same way for one agent and for several, so that results are equal bit for bit."""

    def __init__(self, outputs):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.randn(outputs, 4))

    def forward(self, x):
        return (x.unsqueeze(-2) * self.weight).sum(-1)


def agents():
    """Critic and actor of a group, and the same two of one agent."""
    torch.manual_seed(1)
    value, logits = Rows(1), Rows(3)
    pairs = []
    for group in (("agents",), ()):
        observation, state_value, name, action = (
            (*group, key) if group else key for key in ("observation", "state_value", "logits", "action")
        )
        critic = TensorDictModule(value, in_keys=[observation], out_keys=[state_value])
        net = TensorDictModule(logits, in_keys=[observation], out_keys=[name])
        actor = ProbabilisticActor(
            net, in_keys={"logits": name}, out_keys=[action], distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )  # fmt: skip
        assert isinstance(actor, ProbabilisticTensorDictSequential)
        pairs.append((critic, actor))
    return pairs


BLOCKS = {
    "gae": lambda critic, actor: advantages.GAE(critic, gamma=0.9, lmbda=0.8),
    "td_lambda": lambda critic, actor: advantages.TDLambda(critic, gamma=0.9, lmbda=0.8),
    "n_step": lambda critic, actor: advantages.NStep(critic, gamma=0.9, steps=3),
    "monte_carlo": lambda critic, actor: advantages.MonteCarlo(critic, gamma=0.9, reward_to_go=False),
    "vtrace": lambda critic, actor: advantages.VTrace(critic, actor, gamma=0.9, lmbda=0.8),
}


@pytest.mark.parametrize("name", BLOCKS)
@pytest.mark.parametrize("own_flags", [False, True])
@pytest.mark.parametrize("own_reward", [True, False])
def test_each_agent_as_if_it_were_alone(name, own_flags, own_reward):
    rollout = group_rollout(own_flags, own_reward)
    group, single = agents()
    block = BLOCKS[name](*group)
    out = block(rollout.copy())
    for i in range(A):
        alone = BLOCKS[name](*single)(agent_alone(rollout, i))
        for key in ("advantage", "value_target", "state_value"):
            assert torch.equal(out["agents", key][:, :, i], alone[key]), key
    assert {("agents", "advantage"), ("agents", "value_target"), ("agents", "state_value")} <= set(block.out_keys)
    assert set(block.out_keys) <= set(out.keys(True))


def test_time_is_the_last_batch_dimension():
    rollout, (group, _) = group_rollout(), agents()
    whole = advantages.GAE(group[0])(rollout.copy())
    for i in range(N):
        row = advantages.GAE(group[0])(rollout[i].copy())
        assert torch.equal(row["agents", "advantage"], whole["agents", "advantage"][i])


def test_equals_torchrl_s_with_its_own_network():
    torch.manual_seed(0)
    net = MultiAgentMLP(4, 1, A, centralized=True, share_params=True, depth=1, num_cells=8)
    critic = TensorDictModule(net, in_keys=[("agents", "observation")], out_keys=[("agents", "state_value")])
    rollout = group_rollout()
    mine = advantages.GAE(critic, gamma=0.9, lmbda=0.8)(rollout.copy())
    theirs = MultiAgentGAE(gamma=0.9, lmbda=0.8, value_network=critic)
    theirs.set_keys(
        advantage=("agents", "advantage"), value_target=("agents", "value_target"), value=("agents", "state_value"),
        reward=("agents", "reward"),
    )  # fmt: skip
    expected = theirs(rollout.copy())
    for key in ("advantage", "value_target"):
        torch.testing.assert_close(mine["agents", key], expected["agents", key], rtol=1e-4, atol=1e-5)


def test_set_keys_names_the_entries():
    rollout, (group, _) = group_rollout(own_flags=True), agents()
    rollout["next", "ended"], rollout["next", "agents", "pay"] = (
        rollout["next", "done"],
        2 * rollout["next", "agents", "reward"],
    )
    block = advantages.GAE(group[0])
    block.set_keys(
        reward=("agents", "pay"), done="ended", terminated="terminated", advantage="a", value_target=("x", "t")
    )
    out = block(rollout.copy())
    plain = rollout.clone()
    for name in ("done", "terminated"):
        del plain["next", "agents", name]
    plain["next", "agents", "reward"] = 2 * rollout["next", "agents", "reward"]
    expected = advantages.GAE(group[0])(plain)
    assert torch.equal(out["a"], expected["agents", "advantage"])
    assert torch.equal(out["x", "t"], expected["agents", "value_target"])
    assert ("next", "ended") in block.in_keys and ("next", "agents", "done") not in block.in_keys
    with pytest.raises(UserError, match="GAE.set_keys: 'rewards' is none of advantage, value_target, value, reward"):
        block.set_keys(rewards="pay")
    block.set_keys(reward="nothing")
    with pytest.raises(UserError, match=r"no \('next', 'nothing'\), which GAE reads"):
        block(rollout)


def test_standardized_over_the_team_or_by_agent_and_masked_steps_do_not_count():
    rollout, (group, _) = group_rollout(), agents()
    plain = advantages.GAE(group[0])(rollout.copy())["agents", "advantage"]
    rows, members = torch.rand(N, T) < 0.7, torch.rand(N, T, A) < 0.7

    def average(**settings):
        return advantages.GAE(group[0], average_gae=True, **settings)(rollout.copy())["agents", "advantage"]

    assert torch.equal(average(), standardize(plain))
    for i in range(A):
        torch.testing.assert_close(average(per_agent=True)[:, :, i], standardize(plain[:, :, i]))
    rollout["collector"] = {"mask": rows}
    kept = rows[..., None].expand(N, T, A)
    torch.testing.assert_close(average()[kept], standardize(plain[kept]))
    rollout["agents", "mask"] = members
    kept = kept & members
    torch.testing.assert_close(average()[kept], standardize(plain[kept]))
    for i in range(A):
        own = average(per_agent=True)[:, :, i][kept[:, :, i]]
        torch.testing.assert_close(own, standardize(plain[:, :, i][kept[:, :, i]]))


def test_a_scale_for_each_agent():
    # with scales 2 and 5 the critic's V means 2 V and 5 V: as two critics with those values
    rollout, (group, single) = group_rollout(), agents()
    scale = modules.ReturnScale((A, 1))
    scale.var.copy_(torch.tensor([[4.0], [25.0]]))
    out = advantages.GAE(group[0], gamma=0.9, return_scale=scale)(rollout.copy())
    weight = single[0].module.weight
    for i, times in enumerate((2.0, 5.0)):
        with torch.no_grad():
            weight.mul_(times)
        alone = advantages.GAE(single[0], gamma=0.9)(agent_alone(rollout, i))
        with torch.no_grad():
            weight.div_(times)
        torch.testing.assert_close(out["agents", "advantage"][:, :, i], alone["advantage"], rtol=1e-5, atol=1e-5)
        target = out["agents", "value_target"][:, :, i] * times
        torch.testing.assert_close(target, alone["value_target"], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("own_flags", [False, True])
def test_recorded_it_gives_the_same(own_flags):
    rollout, (group, _) = group_rollout(own_flags), agents()
    rollout["collector"] = {"mask": torch.rand(N, T) < 0.7}
    block = advantages.GAE(group[0], average_gae=True)
    recorded = CompiledAdvantage(block, "on")
    recorded(rollout.copy())
    other = group_rollout(own_flags)
    other["collector"] = {"mask": torch.rand(N, T) < 0.5}
    torch.testing.assert_close(
        recorded(other.copy())["agents", "advantage"], block(other.copy())["agents", "advantage"]
    )


def test_without_a_critic_the_keys_are_named():
    rollout = group_rollout()
    block = advantages.MonteCarlo(gamma=0.9)
    block.set_keys(reward=("agents", "reward"), advantage=("agents", "advantage"), value_target=("agents", "t"))
    out = block(rollout.copy())
    for i in range(A):
        alone = advantages.MonteCarlo(gamma=0.9)(agent_alone(rollout, i))
        assert torch.equal(out["agents", "advantage"][:, :, i], alone["advantage"])


def test_a_critic_of_another_shape_is_named():
    critic = TensorDictModule(Rows(2), in_keys=[("agents", "observation")], out_keys=[("agents", "state_value")])
    with pytest.raises(UserError, match=r"is \(2, 2\) for one observation, GAE reads one value an agent, \(2, 1\)"):
        advantages.GAE(critic)(group_rollout())
