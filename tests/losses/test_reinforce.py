"""REINFORCE's loss: values by hand, agreement with TorchRL's, with and without a baseline."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import ValueOperator
from torchrl.objectives import ReinforceLoss as TorchRLReinforceLoss

from pgkit import envs, losses, modules
from tests.losses.test_a2c import by_hand as a2c_by_hand


def test_values_and_gradients_by_hand():
    # the numbers of A2C's test: objective c - 1/4 with slope 1/2 in w; value error 2.5 with slope 3
    c = 0.5 * math.log(2 * math.pi)
    actor, value, _, batch = a2c_by_hand()
    out = losses.ReinforceLoss(actor, ValueOperator(value, in_keys=["observation"]))(batch)
    assert out["loss_actor"].item() == pytest.approx(-(c - 0.25), abs=1e-12)
    assert out["loss_value"].item() == pytest.approx(2.5, abs=1e-12)
    w, weight = next(actor.parameters()), value.weight
    assert torch.autograd.grad(out["loss_actor"], w)[0].item() == pytest.approx(-0.5, abs=1e-12)
    assert torch.autograd.grad(out["loss_value"], weight)[0].item() == pytest.approx(3.0, abs=1e-12)


def test_without_a_baseline_only_the_policy_is_trained():
    actor, _, _, batch = a2c_by_hand()
    loss = losses.ReinforceLoss(actor)
    out = loss(batch.select("observation", "action", "advantage"))
    assert list(out.keys()) == loss.out_keys == ["loss_actor"]
    assert loss.in_keys == ["observation", "action", "advantage"]


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
@pytest.mark.parametrize("kwargs", [{"loss_critic_type": "smooth_l1"}, {"clip_value": 0.2, "reduction": "sum"}])
def test_agrees_with_torchrl(env_id, kwargs):
    torch.manual_seed(0)
    env = envs.make(env_id)
    build = modules.gaussian_actor if env_id == "Pendulum-v1" else modules.categorical_actor
    actor, critic = build(env), modules.state_value(env)
    batch = actor(TensorDict({"observation": torch.randn(32, *env.observation_spec["observation"].shape[1:])}, [32]))
    batch = batch.detach()
    for key in ("advantage", "value_target", "state_value"):
        batch[key] = torch.randn(32, 1)
    settings = {"loss_critic_type": "l2"} | kwargs
    mine, theirs = losses.ReinforceLoss(actor, critic, **settings), TorchRLReinforceLoss(actor, critic, **settings)
    a, b = mine(batch), theirs(batch.copy())
    parameters = [*actor.parameters(), *critic.parameters()]
    for key in ("loss_actor", "loss_value"):
        torch.testing.assert_close(a[key].squeeze(), b[key].squeeze(), rtol=1e-4, atol=1e-5)
    totals = [out["loss_actor"] + out["loss_value"] for out in (a, b)]
    for g, h in zip(*(torch.autograd.grad(total, parameters) for total in totals), strict=True):
        torch.testing.assert_close(g, h, rtol=1e-3, atol=1e-5)
