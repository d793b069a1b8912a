import copy

import pytest
import torch
from torchrl.objectives.value import GAE as TorchRLGAE

from pgkit import advantages, collectors, envs, modules


@pytest.fixture(scope="module")
def agent():
    torch.manual_seed(0)
    env = envs.make("CartPole-v1", num_envs=3, seed=5)
    actor, critic = modules.categorical_actor(env), modules.state_value(env)
    collector = collectors.VectorCollector(env, actor, frames_per_batch=3 * 70)
    return critic, collector.rollout()


def test_equals_torchrl_on_a_real_rollout(agent):
    critic, rollout = agent
    assert rollout["next", "terminated"].sum() > 3
    mine = advantages.GAE(critic, gamma=0.97, lmbda=0.9)(rollout.copy())
    theirs = TorchRLGAE(gamma=0.97, lmbda=0.9, value_network=critic, vectorized=False)(rollout.copy())
    torch.testing.assert_close(mine["advantage"], theirs["advantage"], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(mine["value_target"], theirs["value_target"], rtol=1e-4, atol=1e-5)


def test_bootstraps_with_the_final_observation(agent):
    # the next value of a truncated step is V of ("next", "observation") there, not of the entry after it
    critic, rollout = agent
    rollout = rollout.clone()
    rollout["next", "terminated"][:] = False
    rollout["next", "done"][:, 10] = True
    rollout["next", "observation"][:, 10] = 7.0
    out = advantages.GAE(critic, gamma=0.9, lmbda=0.0)(rollout)
    with torch.no_grad():
        final = critic(rollout["next"][:, 10].select("observation"))["state_value"]
    expected = rollout["next", "reward"][:, 10] + 0.9 * final
    torch.testing.assert_close(out["value_target"][:, 10], expected)


def test_average_gae_standardizes_the_rollout(agent):
    critic, rollout = agent
    advantage = advantages.GAE(critic, average_gae=True)(rollout.copy())["advantage"]
    assert advantage.mean().item() == pytest.approx(0, abs=1e-5)
    assert advantage.std().item() == pytest.approx(1, abs=1e-4)


def test_return_scale_changes_the_target_only_in_unit(agent):
    # with scale s the critic's V means s*V: delta = r + g*s*V' - s*V
    critic, rollout = agent
    scale = modules.ReturnScale()
    scale.var.fill_(9.0)
    out = advantages.GAE(critic, gamma=0.9, lmbda=0.0, return_scale=scale)(rollout.copy())
    with torch.no_grad():
        after = critic(rollout["next"].select("observation"))["state_value"]
    target = rollout["next", "reward"] + 0.9 * 3 * after * ~rollout["next", "terminated"]
    torch.testing.assert_close(out["value_target"] * 3, target, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(out["advantage"], target - 3 * out["state_value"], rtol=1e-4, atol=1e-4)
    scale.update(out["value_target"])
    assert scale.scale.item() == pytest.approx(target.std(correction=0).item(), rel=1e-3)


@pytest.mark.parametrize("kind", [advantages.GAE, advantages.TDLambda, lambda critic: advantages.VTrace(critic, None)])
def test_its_numbers_lie_where_the_critic_is(agent, kind):
    block = kind(copy.deepcopy(agent[0]).to("meta"))
    assert block.gamma.device.type == block.lmbda.device.type == "meta" and block.gamma.dtype == torch.float64
