"""PPO-penalty's loss: values by hand, agreement with TorchRL's, its coefficient's two owners."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import KLPENPPOLoss as TorchRLKLPENPPOLoss

from pgkit import controllers, envs, losses, modules
from tests.losses.test_a2c import by_hand as a2c_by_hand


def by_hand(**kwargs):
    """The actor N(x, 1) of A2C's test; the old policy was N(x - 1, 2)."""
    actor, _, _, batch = a2c_by_hand()
    batch["loc"], batch["scale"] = batch["observation"] - 1, torch.full_like(batch["observation"], 2.0)
    old = actor.build_dist_from_params(batch.select("loc", "scale"))
    batch["action_log_prob"] = old.log_prob(batch["action"])
    settings = {"normalize_advantage": False, "entropy_bonus": False} | kwargs
    return actor, losses.KLPENPPOLoss(actor, **settings), batch


def test_values_and_gradient_by_hand():
    # KL(N(x-1, 2) || N(x, 1)) = log(1/2) + (4 + 1)/2 - 1/2 = 2 - log 2
    # actions 2, 2 at x = 1, 2: log pi = -1/2, 0 (- c); log pi_old = -(2/2)^2/2, -(1/2)^2/2 (- c - log 2)
    # ratios 2 exp(-1/2 + 1/2) = 2 and 2 exp(1/8); A = 1, -3: objective (2 - 6 exp(1/8)) / 2, minus beta KL
    actor, loss, batch = by_hand(beta=0.5, dtarg=1.0)
    kl = 2 - math.log(2)
    out = loss(batch)
    assert out["loss_objective"].item() == pytest.approx(-(1 - 3 * math.exp(1 / 8) - 0.5 * kl), abs=1e-12)
    assert out["kl"].item() == pytest.approx(kl, abs=1e-12) and out["beta"].item() == 0.5
    estimate = (2 - 1 - math.log(2) + 2 * math.exp(1 / 8) - 1 - math.log(2) - 1 / 8) / 2  # ratio - 1 - log ratio
    assert out["kl_approx"].item() == pytest.approx(estimate, abs=1e-12)
    # slope in w: d ratio / dw = ratio (a - w x) x: 2 * 1, 0; d KL / dw = (w x - x + 1) x = x: 1, 2 -> mean 1.5
    (slope,) = torch.autograd.grad(out["loss_objective"], list(actor.parameters()))
    assert slope.item() == pytest.approx(-(2 / 2 - 0.5 * 1.5), abs=1e-12)


def test_without_a_controller_it_adapts_in_every_call_as_torchrl_s_does():
    _, loss, batch = by_hand(beta=1.0, dtarg=0.1)  # KL 1.3, above 1.5 * 0.1
    assert [loss(batch)["beta"].item() for _ in range(3)] == [1, 2, 4] and loss.beta.item() == 8
    _, loss, batch = by_hand(beta=1.0, dtarg=10.0, decrement=0.25)
    assert [loss(batch)["beta"].item() for _ in range(2)] == [1, 0.25]


def test_a_controller_owns_the_coefficient_and_its_state():
    penalty, fixed = controllers.AdaptiveKL(target=0.1, beta=0.5), controllers.FixedKL(3.0)
    _, loss, batch = by_hand(controller=penalty)
    assert [loss(batch)["beta"].item() for _ in range(2)] == [0.5, 0.5]
    assert penalty.update(loss.kl(batch)) == 1.0
    assert loss(batch)["beta"].item() == 1.0 and loss.state_dict()["controller.beta"].item() == 1.0
    _, loss, _ = by_hand(controller=fixed)
    assert fixed.update(loss.kl(batch)) == loss(batch)["beta"].item() == 3.0


def agent(env_id):
    torch.manual_seed(0)
    env = envs.make(env_id)
    if env_id == "CartPole-v1":
        return env, modules.categorical_actor(env), modules.state_value(env)
    build = modules.tanh_normal_actor if env_id == "tanh" else modules.gaussian_actor
    return env, build(env), modules.state_value(env)


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
@pytest.mark.parametrize("kwargs", [{"dtarg": 1e-5}, {"dtarg": 10.0}, {"increment": 1.0, "decrement": 1.0}])
def test_agrees_with_torchrl(env_id, kwargs):
    # gradients where beta stays: TorchRL changes it in place before the backward pass, which then takes the new one
    env, actor, critic = agent(env_id)
    batch = TensorDict({"observation": torch.randn(32, *env.observation_spec["observation"].shape[1:])}, [32])
    batch = actor(batch).detach()
    for parameter in actor.parameters():
        parameter.data += 0.05 * torch.randn_like(parameter)
    for key in ("advantage", "value_target", "state_value"):
        batch[key] = torch.randn(32, 1)
    settings = {"loss_critic_type": "l2", "entropy_coeff": 0.01, "normalize_advantage": False} | kwargs
    mine, theirs = losses.KLPENPPOLoss(actor, critic, **settings), TorchRLKLPENPPOLoss(actor, critic, **settings)
    parameters = [*actor.parameters(), *critic.parameters()]
    for _ in range(2):
        a, b = mine(batch), theirs(batch.copy())
        for key in ("loss_objective", "loss_critic", "loss_entropy", "entropy"):
            torch.testing.assert_close(a[key].squeeze(), b[key].squeeze(), rtol=1e-4, atol=1e-5, msg=key)
        torch.testing.assert_close(a["kl"], b["kl"].mean())
        torch.testing.assert_close(mine.beta, theirs.beta)
        if "dtarg" in kwargs:
            continue
        totals = [sum(v.sum() for k, v in out.items() if k.startswith("loss_")) for out in (a, b)]
        for g, h in zip(*(torch.autograd.grad(total, parameters) for total in totals), strict=True):
            torch.testing.assert_close(g, h, rtol=1e-3, atol=1e-5)
    assert (mine.beta != 1.0) == ("dtarg" in kwargs)


def test_kept_distribution_is_the_old_one_and_a_missing_one_is_named():
    _, actor, _ = agent("Pendulum-v1")
    loss = losses.KLPENPPOLoss(actor)
    batch = actor(TensorDict({"observation": torch.randn(8, 3)}, [8])).detach().exclude("loc", "scale")
    with pytest.raises(KeyError, match="the batch has no 'loc'.*keep_distribution"):
        loss.kl(batch)
    loss.keep_distribution(batch)
    assert loss.kl(batch).abs().max() < 1e-6 and not batch["loc"].requires_grad
    log_std = next(p for name, p in actor.named_parameters() if name.endswith("log_std"))
    log_std.data += 1.0  # deviation times e: KL = 1 + exp(-2)/2 - 1/2
    torch.testing.assert_close(loss.kl(batch).detach(), torch.full((8,), 0.5 + math.exp(-2) / 2))
