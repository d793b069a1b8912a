"""A2C's loss: values by hand, agreement with TorchRL's, gradients."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import A2CLoss as TorchRLA2CLoss

from pgkit import envs, losses, modules


class Normal(nn.Module):
    """Mean ``w x``, deviation 1."""

    def __init__(self):
        super().__init__()
        self.w = nn.Parameter(torch.tensor(1.0, dtype=torch.float64))

    def forward(self, x):
        return self.w * x, torch.ones_like(x)


def by_hand(**kwargs):
    actor = ProbabilisticActor(
        TensorDictModule(Normal(), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True,
    )  # fmt: skip
    value = nn.Linear(1, 1, bias=False).double()
    value.weight.data.fill_(3.0)
    column = lambda *x: torch.tensor(x, dtype=torch.float64).unsqueeze(-1)  # noqa: E731
    batch = TensorDict(
        {
            "observation": column(1, 2),
            "action": column(2, 2),
            "advantage": column(1, -3),
            "value_target": column(4, 4),
            "state_value": column(2, 6),
        },
        [2],
    )
    return actor, value, losses.A2CLoss(actor, ValueOperator(value, in_keys=["observation"]), **kwargs), batch


def test_values_and_gradients_by_hand():
    # log pi = -(a - w x)^2 / 2 - log(2 pi) / 2 at w = 1: -1/2 - c and -c, with c = 0.9189...
    # objective: (1 * (-1/2 - c) - 3 * (-c)) / 2 = c - 1/4; its slope in w: mean of A (a - w x) x = (1 + 0) / 2
    # V = 3, 6 against 4, 4: (1 + 4) / 2 = 2.5; slope in the weight: mean of 2 (V - target) x = (-2 + 8) / 2 = 3
    # entropy of a unit Gaussian: 1/2 + c
    c = 0.5 * math.log(2 * math.pi)
    actor, value, loss, batch = by_hand(entropy_coeff=0.125, critic_coeff=0.5)
    out = loss(batch)
    assert out["loss_objective"].item() == pytest.approx(-(c - 0.25), abs=1e-12)
    assert out["loss_critic"].item() == pytest.approx(0.5 * 2.5, abs=1e-12)
    assert out["loss_entropy"].item() == pytest.approx(-0.125 * (0.5 + c), abs=1e-12)
    assert out["entropy"].item() == pytest.approx(0.5 + c, abs=1e-12)
    w, weight = next(actor.parameters()), value.weight
    for name, expected in (("loss_objective", (-0.5, 0.0)), ("loss_critic", (0.0, 1.5))):
        grads = torch.autograd.grad(out[name], [w, weight], allow_unused=True, retain_graph=True)
        assert [0.0 if g is None else g.item() for g in grads] == pytest.approx(expected, abs=1e-12)


def test_clipped_value_by_hand():
    # old 2, 6, clip 1/2. V = 3: (3 - 4)^2 = 1 against (2.5 - 4)^2 = 2.25; V = 6: 4 either way. Mean 3.125
    *_, loss, batch = by_hand(clip_value=0.5)
    assert loss(batch)["loss_critic"].item() == pytest.approx(3.125, abs=1e-12)


def test_advantage_is_normalized_only_if_asked():
    # A = 1, -3: mean -1, deviation sqrt(8), so +-1/sqrt(2); objective ((-1/2 - c) - (-c)) / (2 sqrt(2))
    *_, loss, batch = by_hand(normalize_advantage=True)
    assert loss(batch)["loss_objective"].item() == pytest.approx(0.25 / math.sqrt(2), abs=1e-6)


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
@pytest.mark.parametrize(
    "kwargs", [{"entropy_coeff": 0.01}, {"critic_coeff": 0.5, "clip_value": 0.2}, {"reduction": "sum"}]
)
def test_agrees_with_torchrl(env_id, kwargs):
    torch.manual_seed(0)
    env = envs.make(env_id)
    build = modules.gaussian_actor if env_id == "Pendulum-v1" else modules.categorical_actor
    actor, critic = build(env), modules.state_value(env)
    batch = actor(TensorDict({"observation": torch.randn(32, *env.observation_spec["observation"].shape[1:])}, [32]))
    batch = batch.detach()
    for key in ("advantage", "value_target", "state_value"):
        batch[key] = torch.randn(32, 1)
    settings = {"loss_critic_type": "l2", "entropy_coeff": 0.02} | kwargs
    mine, theirs = losses.A2CLoss(actor, critic, **settings), TorchRLA2CLoss(actor, critic, **settings)
    a, b = mine(batch), theirs(batch.copy())
    assert {"loss_objective", "loss_critic", "loss_entropy", "entropy"} <= set(a.keys()) & set(b.keys())
    for key in set(a.keys()) & set(b.keys()):
        torch.testing.assert_close(a[key].squeeze(), b[key].squeeze(), rtol=1e-4, atol=1e-5, msg=key)
    parameters = [*actor.parameters(), *critic.parameters()]
    totals = [sum(v.sum() for k, v in out.items() if k.startswith("loss_")) for out in (a, b)]
    for g, h in zip(*(torch.autograd.grad(total, parameters) for total in totals), strict=True):
        torch.testing.assert_close(g, h, rtol=1e-3, atol=1e-5)


def test_shapes_never_broadcast_and_the_batch_is_left_as_it_was():
    *_, loss, batch = by_hand()
    before = batch.clone()
    loss(batch)
    assert set(batch.keys()) == set(before.keys()) and (batch == before).all()
    with pytest.raises(ValueError, match=r"advantage has shape \(2,\) but log_prob has shape \(2, 1\)"):
        loss(batch.set("advantage", batch["advantage"].squeeze(-1)))
    assert loss.in_keys == ["observation", "action", "advantage", "value_target", "state_value"]


def test_an_action_with_a_gradient_of_its_own_is_refused():
    _, _, loss, batch = by_hand()
    batch["action"].requires_grad_()
    with pytest.raises(RuntimeError, match=r"stored action requires grad: collect under torch.no_grad\(\)"):
        loss(batch)


def test_the_entropy_of_draws_without_a_gradient_has_one():
    # of a Gaussian: dH / d log_std = 1
    class Unreparameterized(torch.distributions.Normal):
        has_rsample = False
        entropy = torch.distributions.Distribution.entropy  # none in closed form

    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    loss = losses.A2CLoss(modules.gaussian_actor(env), modules.state_value(env))
    log_std = torch.full((200_000,), 0.3, requires_grad=True)
    entropy = loss.entropy(Unreparameterized(torch.zeros(200_000), log_std.exp()))
    entropy.mean().backward()
    assert entropy.mean().item() == pytest.approx(0.5 * math.log(2 * math.pi * math.e) + 0.3, abs=0.01)
    assert log_std.grad is not None and log_std.grad.sum().item() == pytest.approx(1.0, abs=0.03)
