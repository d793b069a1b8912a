"""Every estimator through the one interface, on real rollouts and by hand."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives.value import TDLambdaEstimator
from torchrl.objectives.value.functional import vtrace_advantage_estimate

from pgkit import advantages, collectors, envs, modules
from pgkit.compiled.native import record
from tests.modules.test_discrete import Masked


@pytest.fixture(scope="module")
def agent():
    torch.manual_seed(0)
    env = envs.make("CartPole-v1", num_envs=4, seed=5)
    actor, critic = modules.categorical_actor(env), modules.state_value(env)
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=4 * 70).rollout()
    rollout["next", "truncated"][:, 40] = rollout["next", "done"][:, 40] = True
    rollout["next", "terminated"][:, 40] = False
    return actor, critic, rollout


def assert_close(a, b):
    torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


def test_td_lambda_is_gae_by_another_road_and_torchrl_s(agent):
    _, critic, rollout = agent
    mine = advantages.TDLambda(critic, gamma=0.97, lmbda=0.9)(rollout.copy())
    gae = advantages.GAE(critic, gamma=0.97, lmbda=0.9)(rollout.copy())
    theirs = TDLambdaEstimator(gamma=0.97, lmbda=0.9, value_network=critic, vectorized=False)(rollout.copy())
    for key in ("advantage", "value_target"):
        assert_close(mine[key], gae[key])
        assert_close(mine[key], theirs[key])


def test_n_step_between_one_step_and_monte_carlo(agent):
    _, critic, rollout = agent
    pairs = [(1, advantages.GAE(critic, lmbda=0.0)), (70, advantages.MonteCarlo(critic))]
    for steps, other in pairs:
        a, b = advantages.NStep(critic, steps=steps)(rollout.copy()), other(rollout.copy())
        assert_close(a["advantage"], b["advantage"])
        assert_close(a["value_target"], b["value_target"])


def test_on_policy_v_trace_is_gae(agent):
    actor, critic, rollout = agent
    block = advantages.VTrace(critic, actor, gamma=0.97, lmbda=0.9)
    mine, gae = block(rollout.copy()), advantages.GAE(critic, gamma=0.97, lmbda=0.9)(rollout.copy())
    assert_close(mine["advantage"], gae["advantage"])
    assert_close(mine["value_target"], gae["value_target"])
    assert_close(mine["current_log_prob"], rollout["action_log_prob"])


def test_off_policy_v_trace_is_torchrl_s_function(agent):
    # its VTrace block scores an action drawn anew in place of the rollout's, so the function under it is compared
    actor, critic, rollout = agent
    stale = rollout.copy()
    stale["action_log_prob"] = stale["action_log_prob"] + 0.5 * torch.randn(4, 70)
    mine = advantages.VTrace(critic, actor, gamma=0.97, rho_thresh=0.9, c_thresh=0.8)(stale.copy())
    following = stale["next"]
    with torch.no_grad():
        next_value = critic(following.select("observation"))["state_value"]
    log_pi, log_mu = (log_prob.unsqueeze(-1) for log_prob in (rollout["action_log_prob"], stale["action_log_prob"]))
    ends = following["reward"], following["done"], following["terminated"]
    theirs = vtrace_advantage_estimate(0.97, log_pi, log_mu, mine["state_value"], next_value, *ends, 0.9, 0.8)
    assert_close(mine["advantage"], theirs[0])
    assert_close(mine["value_target"], theirs[1])


def test_v_trace_takes_log_probabilities_in_place_of_the_actor(agent):
    actor, critic, rollout = agent
    written = advantages.VTrace(critic, actor)(rollout.copy())
    read = advantages.VTrace(critic, None)(rollout.copy().set("current_log_prob", written["current_log_prob"]))
    assert torch.equal(written["advantage"], read["advantage"])
    with pytest.raises(ValueError, match=r"old_log_prob has shape \(4, 70\) but log_prob has shape \(4, 70, 1\)"):
        advantages.VTrace(critic, None)(rollout.copy().set("current_log_prob", torch.zeros(4, 70, 1)))


def column(*values, dtype=torch.float32):
    return torch.tensor([values], dtype=dtype).unsqueeze(-1)


def by_hand(done, **entries):
    flags = column(*done, dtype=torch.bool)
    following = {"reward": column(1.0, 2.0, 3.0, 4.0), "done": flags, "terminated": flags}
    return TensorDict({"next": following, **entries}, [1, 4])


def test_monte_carlo_by_hand():
    # gamma 1/2, rewards 1 2 | 3 4, the second episode unfinished: returns 2, 2, 5, 4 (nothing after the rollout)
    rollout = by_hand([False, True, False, False])
    out = advantages.MonteCarlo(gamma=0.5)(rollout.copy())
    assert out["advantage"].flatten().tolist() == out["value_target"].flatten().tolist() == [2, 2, 5, 4]
    assert "state_value" not in out.keys()
    # without reward to go: each step has its episode's return
    out = advantages.MonteCarlo(gamma=0.5, reward_to_go=False)(rollout.copy())
    assert out["advantage"].flatten().tolist() == [2, 2, 5, 5] and out["value_target"].flatten().tolist() == [
        2,
        2,
        5,
        4,
    ]


def test_group_relative_by_hand():
    # first episodes: 1 + 2, 1 + 2 + 3 + 4, twice: group means 6.5, deviations 7 / sqrt(2) = 4.95: -+0.7071
    rollout = torch.cat([by_hand([False, True, False, False]), by_hand([False] * 4)] * 2)
    out = advantages.GroupRelative(2)(rollout.copy())["advantage"].squeeze(-1)
    expected = torch.tensor([[-1.0, -1, 0, 0], [1, 1, 1, 1]]).repeat(2, 1) / 2**0.5
    torch.testing.assert_close(out, expected)
    out = advantages.GroupRelative(2, divide=False)(rollout.copy())["advantage"].squeeze(-1)
    torch.testing.assert_close(out, expected.sign() * 3.5)
    with pytest.raises(ValueError, match="not groups of 3"):
        advantages.GroupRelative(3)(rollout)


def blocks(actor, critic):
    return [
        advantages.GAE(critic), advantages.TDLambda(critic), advantages.NStep(critic), advantages.MonteCarlo(critic),
        advantages.VTrace(critic, actor),
    ]  # fmt: skip


def test_one_interface(agent):
    actor, critic, rollout = agent
    scale = modules.ReturnScale()
    scale.var.fill_(9.0)
    tripled = copy.deepcopy(critic)
    for parameter in tripled.module[-1].parameters():
        parameter.data.mul_(3)
    for block in blocks(actor, critic):
        out = block(rollout.copy())
        assert set(block.in_keys) <= set(rollout.keys(True)) and set(block.out_keys) <= set(out.keys())
        for key in ("advantage", "value_target", "state_value"):
            assert out[key].shape == (4, 70, 1) and not out[key].requires_grad
        block.standardize = True
        flat = block(rollout.copy())["advantage"]
        assert flat.mean().abs() < 1e-5 and flat.std().item() == pytest.approx(1, abs=1e-3)
        # with scale 3 the critic's V means 3 V, and the target is given in its unit
        block.standardize, block.return_scale = False, scale
        scaled = block(rollout.copy())
        block.return_scale, block.critic = None, tripled
        plain = block(rollout.copy())
        assert_close(scaled["advantage"], plain["advantage"])
        assert_close(scaled["value_target"] * 3, plain["value_target"])


def test_a_recorded_recurrent_critic_starts_afresh_at_every_end():
    torch.manual_seed(0)
    env = envs.make("pgkit/TMaze-v0", num_envs=4, length=2)
    core = modules.gru(env, 8, (8,))
    actor, critic = modules.categorical_actor(env, encoder=core), modules.state_value(env, encoder=core)
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=4 * 8, compile="off").rollout()
    assert rollout["next", "done"][:, :-1].any()
    block = advantages.GAE(critic)
    entries = [rollout[key] for key in block.in_keys]

    def flat(*entries):
        data = TensorDict({}, rollout.batch_size)
        for key, x in zip(block.in_keys, entries, strict=True):
            data.set(key, x)
        return [block(data)["advantage"]]

    torch.testing.assert_close(record(flat, entries)(*entries)[0], block(rollout.clone())["advantage"])


def test_vtrace_names_what_its_actor_reads():
    env = envs.make(Masked, num_envs=2, flatten=False)
    actor = modules.categorical_actor(env)
    block = advantages.VTrace(modules.state_value(env), actor)
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=12, compile="off").rollout()
    assert "action_mask" in block.in_keys and len(set(block.in_keys)) == len(block.in_keys)
    assert block(rollout.select(*block.in_keys))["advantage"].shape == (2, 6, 1)
