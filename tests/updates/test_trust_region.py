"""TRPO's update: the Fisher product, the step by hand, the bound, the line search, resume, refusals."""

import copy
from typing import cast

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import kl_divergence
from torchrl.modules import IndependentNormal, ProbabilisticActor

from pgkit import advantages, collectors, envs, losses, modules, updates
from pgkit.errors import UserError


def make(env_id="Pendulum-v1", seed=0, dtype=torch.float64, **kwargs):
    torch.manual_seed(seed)
    env = envs.make(env_id)
    build = modules.categorical_actor if env_id == "CartPole-v1" else modules.gaussian_actor
    actor, critic = build(env, (16,)).to(dtype), modules.state_value(env, (16,)).to(dtype)
    update = updates.TrustRegionUpdate(
        losses.TRPOLoss(actor, critic).to(dtype),
        advantages.GAE(critic, average_gae=True).to(dtype),
        torch.optim.Adam(critic.parameters(), lr=1e-3),
        **{"compile": "off", "seed": 1} | kwargs,
    )
    return env.observation_spec["observation"].shape[-1], actor, update


def rollout_of(actor, size, seed=0):
    torch.manual_seed(seed)
    draw = lambda features: torch.randn(4, 64, features, dtype=torch.float64)  # noqa: E731
    rollout = actor(TensorDict({"observation": draw(size)}, [4, 64])).detach()
    done = draw(1) > 2
    after = torch.where(done, draw(size), rollout["observation"].roll(-1, 1))
    rollout["next"] = TensorDict({"observation": after, "reward": draw(1), "done": done, "terminated": done}, [4, 64])
    return rollout


class Mean(nn.Module):
    """Mean ``w x`` with two weights, deviation 2."""

    def __init__(self):
        super().__init__()
        self.w = nn.Parameter(torch.zeros(2, dtype=torch.float64))

    def forward(self, x):
        return (x @ self.w).unsqueeze(-1), torch.full_like(x[..., :1], 2.0)


def gaussian():
    net = TensorDictModule(Mean(), ["observation"], ["loc", "scale"])
    return ProbabilisticActor(
        net, ["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True
    )  # fmt: skip


@pytest.mark.parametrize("masked", [False, True])
def test_natural_step_by_hand(masked):
    # mean w.x, deviation 2, x = (1, 0) and (0, 2): KL of the step dw is the mean of (dw.x)^2 / 8, so
    # F = mean of x x^T / 4 = diag(1/8, 1/2). At w = 0 the gradient of log pi is (a / 4) x: a = 4, 4, A = 1, -1 give
    # the objective's gradient g = mean of A (a / 4) x = (1/2, -1), F^-1 g = (4, -2), g.F^-1 g = 4
    # the step sqrt(2 * 0.02 / 4) = 0.1 times that: (0.4, -0.2). Its KL is (0.16 + 0.16) / 16 = 0.02, the bound
    actor = gaussian()
    batch = TensorDict(
        {
            "observation": torch.tensor([[1.0, 0.0], [0.0, 2.0]], dtype=torch.float64),
            "action": torch.tensor([[4.0], [4.0]], dtype=torch.float64),
            "advantage": torch.tensor([[1.0], [-1.0]], dtype=torch.float64),
        },
        [2],
    )
    dist = actor.get_dist(batch.copy())
    batch["action_log_prob"] = dist.log_prob(batch["action"]).detach()
    if masked:  # a third row that does not count
        batch = cast(TensorDict, batch[[0, 1, 1]])
        batch["observation"][2] = 30.0
        batch["collector", "mask"] = torch.tensor([True, True, False])
    update = updates.TrustRegionUpdate(
        losses.TRPOLoss(actor), None, max_kl=0.02, damping=0.0, line_search=False, compile="off"
    )
    metrics = update(batch)
    torch.testing.assert_close(next(actor.parameters()).tolist(), [0.4, -0.2], rtol=1e-9, atol=1e-9)
    assert metrics["kl"] == pytest.approx(0.02, abs=1e-9) and metrics["cg_error"] < 1e-9
    assert metrics["improvement"] > 0 and metrics["step_size"] == 1.0


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
def test_fisher_product_is_the_hessian_of_the_kl(env_id):
    size, actor, update = make(env_id, damping=0.0)
    batch = update.loss.keep_distribution(rollout_of(actor, size).reshape(-1))
    start = torch.cat([p.detach().flatten() for p in update._params])
    v = torch.randn(len(start), generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def slope(vector):
        update._assign(vector)
        return torch.cat([g.flatten() for g in torch.autograd.grad(update.loss.kl(batch).mean(), update._params)])

    expected = (slope(start + 1e-5 * v) - slope(start - 1e-5 * v)) / 2e-5
    update._assign(start)
    torch.testing.assert_close(update._fisher(batch)(v), expected, rtol=1e-4, atol=1e-7)
    assert v @ expected > 0


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
def test_every_accepted_step_improves_within_the_bound(env_id):
    size, actor, update = make(env_id, max_kl=0.05, damping=0.0)
    taken = []
    for i in range(8):
        rollout = rollout_of(actor, size, i)
        before = torch.cat([p.detach().flatten().clone() for p in actor.parameters()])
        old = copy.deepcopy(actor).get_dist(rollout.select("observation"))
        metrics = update(rollout)
        after = torch.cat([p.detach().flatten() for p in actor.parameters()])
        # measured again, without the update's own code
        dist = actor.get_dist(rollout.select("observation"))
        assert kl_divergence(old, dist).mean().item() == pytest.approx(metrics["kl"], abs=1e-5)
        assert torch.equal(before, after) == (metrics["step_size"] == 0)
        if metrics["step_size"]:
            taken.append(metrics)
            ratio = (dist.log_prob(rollout["action"]) - rollout["action_log_prob"]).exp()
            gain = (ratio * rollout["advantage"].squeeze(-1)).mean() - rollout["advantage"].mean()
            assert gain.item() == pytest.approx(metrics["improvement"], abs=1e-4) and gain > 0
    assert len(taken) >= 4 and all(0 < m["kl"] <= 0.05 for m in taken)
    assert max(m["kl"] for m in taken) > 0.025


def test_a_step_that_does_not_improve_is_refused():
    size, actor, update = make(max_kl=0.05, backtracks=2)
    rollout, loss = rollout_of(actor, size), update.loss
    forward, worst = loss.forward, iter([0.0, *[1.0] * 99])
    update(rollout_of(actor, size, 1))  # assembled
    before = [p.detach().clone() for p in actor.parameters()]

    def worse(batch):
        out = forward(batch)
        out["loss_objective"] = out["loss_objective"] * 0 + out["loss_objective"] * 1e-9 + next(worst)
        return out

    loss.forward = worse
    metrics = update(rollout)
    assert metrics["step_size"] == metrics["kl"] == metrics["improvement"] == 0
    assert all(torch.equal(p, old) for p, old in zip(actor.parameters(), before, strict=True))


def test_resume_is_exact_and_the_compiled_critic_agrees():
    size, actor, update = make()
    first, second = rollout_of(actor, size, 0), rollout_of(actor, size, 1)
    update(first.copy())
    state = copy.deepcopy(update.state_dict())
    expected = update(second.copy())
    for mode in ("off", "on"):
        _, _, again = make(seed=9, compile=mode)
        again.load_state_dict(copy.deepcopy(state))
        got = again(second.copy())
        assert got == expected if mode == "off" else got == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_a_shared_parameter_is_refused():
    env = envs.make("Pendulum-v1")
    actor, critic = modules.gaussian_actor(env), modules.state_value(env)
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()])
    with pytest.raises(UserError, match=r"build the optimizer from critic.parameters\(\) alone"):
        updates.TrustRegionUpdate(losses.TRPOLoss(actor, critic), None, optimizer)


def test_recurrent_networks_are_refused():
    env = envs.make("CartPole-v1", num_envs=2)
    core = modules.gru(env, 8)
    actor = modules.categorical_actor(env, encoder=core)
    update = updates.TrustRegionUpdate(losses.TRPOLoss(actor), None)
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=16).rollout()
    rollout["advantage"] = torch.randn(2, 8, 1)
    with pytest.raises(UserError, match="use OnPolicyUpdate with sequence_length"):
        update(rollout)
