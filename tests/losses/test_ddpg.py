"""DDPG's loss: values by hand, agreement with TorchRL's, gradients, refusals."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import DDPGLoss as TorchRLDDPGLoss
from torchrl.objectives import SoftUpdate

from pgkit import collectors, data, envs, heads, losses, modules, updates
from pgkit.errors import UserError


def batch(size=32, obs=17, actions=6, dtype=torch.float64):
    return TensorDict(
        {
            "observation": torch.randn(size, obs, dtype=dtype),
            "action": torch.rand(size, actions, dtype=dtype) * 2 - 1,
            "next": {
                "observation": torch.randn(size, obs, dtype=dtype),
                "reward": torch.randn(size, 1, dtype=dtype),
                "done": torch.rand(size, 1) < 0.5,
                "terminated": torch.rand(size, 1) < 0.3,
            },
        },
        [size],
    )


class Constant(nn.Module):
    def __init__(self):
        super().__init__()
        self.action = nn.Parameter(torch.tensor([0.8], dtype=torch.float64))

    def forward(self, observation):
        return self.action.expand(len(observation), 1)


class Linear(nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([2.0], dtype=torch.float64))

    def forward(self, observation, action):
        return observation * self.weight + action


def by_hand():
    actor = TensorDictModule(Constant(), ["observation"], ["action"])
    critic = TensorDictModule(Linear(), ["observation", "action"], ["state_action_value"])
    loss = losses.DDPGLoss(actor, critic, gamma=0.5)
    SoftUpdate(loss, tau=0.1)
    number = lambda *x: torch.tensor(x, dtype=torch.float64).unsqueeze(-1)  # noqa: E731
    data = TensorDict(
        {
            "observation": number(1, 1, 1),
            "action": number(0.5, 0.5, 0.5),
            "next": {
                "observation": number(2, 2, 2),
                "reward": number(1, 1, 1),
                "terminated": torch.tensor([[False], [False], [True]]),
                "done": torch.tensor([[False], [True], [True]]),
            },
        },
        [3],
    )
    return loss, data


def test_values_by_hand():
    # Q'(2, 0.8) = 4.8: y = 1 + 0.5 * 4.8 = 3.4 (also where truncated), 1 where terminated; Q(1, 0.5) = 2.5
    # errors -0.9, -0.9, 1.5: squares 0.81, 0.81, 2.25: mean 3.87 / 3; actor: -Q(1, 0.8) = -2.8
    loss, data = by_hand()
    out = loss(data)
    assert out["loss_value"].item() == pytest.approx(3.87 / 3)
    assert out["loss_actor"].item() == pytest.approx(-2.8)
    assert out["target_value"].item() == pytest.approx(7.8 / 3) and out["target_value_max"].item() == pytest.approx(3.4)
    assert out["pred_value"].item() == out["pred_value_max"].item() == pytest.approx(2.5)
    torch.testing.assert_close(data["td_error"], torch.tensor([0.9, 0.9, 1.5], dtype=torch.float64))
    weighted = loss(data.set("priority_weight", torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))
    assert weighted["loss_value"].item() == pytest.approx(0.75) and weighted["loss_actor"].item() == pytest.approx(-2.8)


@pytest.mark.parametrize("distance", ["l2", "smooth_l1"])
@pytest.mark.parametrize("delay_actor", [True, False])
def test_agrees_with_torchrl(distance, delay_actor):
    env = envs.make("HalfCheetah-v5")
    actor, critic = modules.deterministic_actor(env, (16,)).double(), modules.q_value(env, 1, (16,)).double()
    settings = {"loss_function": distance, "delay_actor": delay_actor}
    theirs = TorchRLDDPGLoss(actor, critic, **settings)
    theirs.make_value_estimator(gamma=0.97)
    mine = losses.DDPGLoss(actor, critic, gamma=0.97, **settings).double()
    theirs.double()
    for loss in (mine, theirs):
        SoftUpdate(loss, tau=0.1)
        torch.manual_seed(1)
        targets = [loss.target_value_network_params, *([loss.target_actor_network_params] if delay_actor else [])]
        for x in [x for target in targets for x in target.values(True, True)]:
            x.data.add_(torch.randn(x.shape[-2:], dtype=x.dtype).expand_as(x) * 0.1)
    data = batch()
    results = []
    for loss in (mine, theirs):
        copy = data.copy()
        out = loss(copy)
        params = [*actor.parameters(), *loss.value_network_params.values(True, True)]
        results.append((out, copy["td_error"], torch.autograd.grad(out["loss_actor"] + out["loss_value"], params)))
    (a, a_error, a_grads), (b, b_error, b_grads) = results
    for key in ("loss_actor", "loss_value", "pred_value", "target_value"):
        torch.testing.assert_close(a[key], b[key].mean())
    for key in ("pred_value_max", "target_value_max"):
        torch.testing.assert_close(a[key], b[key])
    torch.testing.assert_close(a_error.square(), b_error)  # theirs is squared
    for x, y in zip(a_grads, b_grads, strict=True):
        torch.testing.assert_close(x.reshape_as(y), y)
    assert set(mine.out_keys) == set(a.keys()) and set(mine.out_keys) | {"td_error"} == set(b.keys())


def test_each_term_trains_its_own_parameters():
    env = envs.make("HalfCheetah-v5")
    actor, critic = modules.deterministic_actor(env, (8,)), modules.q_value(env, 1, (8,))
    loss = losses.DDPGLoss(actor, critic)
    SoftUpdate(loss, tau=0.1)
    out = loss(batch(dtype=torch.float32))
    groups = {"loss_actor": [*actor.parameters()], "loss_value": [*critic.parameters()]}
    for key in groups:
        for name, params in groups.items():
            grads = torch.autograd.grad(out[key], params, allow_unused=True, retain_graph=True)
            assert all((g is not None and bool(g.any())) == (name == key) for g in grads)


@pytest.mark.parametrize("loss", ["pgkit", "torchrl"])
def test_eager_equals_compiled(loss):
    results = []
    for compile in ("off", "on"):
        torch.manual_seed(0)
        env = envs.make("Pendulum-v1")
        actor, critic = modules.deterministic_actor(env, (16,)), modules.q_value(env, 1, (16,))
        if loss == "pgkit":
            module = losses.DDPGLoss(actor, critic, gamma=0.9)
        else:
            module = TorchRLDDPGLoss(actor, critic, delay_actor=True)
            module.make_value_estimator(gamma=0.9)
        update = updates.OffPolicyUpdate(
            module, data.ReplayBuffer(env, 500, seed=0), torch.optim.Adam(module.parameters(), lr=1e-2),
            batch_size=32, learning_starts=64, updates_per_step=0.15, compile=compile,
        )  # fmt: skip
        collector = collectors.VectorCollector(env, modules.GaussianExploration(actor, env), frames_per_batch=32)
        for _ in range(4):
            metrics = update(collector.rollout())
        weights = torch.cat([p.detach().flatten() for p in [*actor.parameters(), *module.parameters()]])
        results.append((weights, metrics["loss_actor"], metrics["loss_value"]))
    for x, y in zip(*results, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-3, atol=1e-4)


def test_refusals():
    env = envs.make("Pendulum-v1")
    with pytest.raises(UserError, match="DDPGLoss needs an actor that gives one action.*deterministic_actor"):
        losses.DDPGLoss(modules.gaussian_actor(env), modules.q_value(env, 1))
    with pytest.raises(UserError, match="one critic, these are 2.*TD3Loss"):
        losses.DDPGLoss(modules.deterministic_actor(env), modules.q_value(env))
    with pytest.raises(UserError, match="one critic, these are 2.*TD3Loss"):
        losses.DDPGLoss(modules.deterministic_actor(env), [modules.q_value(env, 1), modules.q_value(env, 1)])


@pytest.mark.parametrize("outputs", [1, 5])
def test_outputs_that_are_not_the_head_s_are_refused(outputs):
    # 1 output would be trained as the median alone, 5 without a head as 5 critics
    actor = TensorDictModule(nn.Linear(17, 6), ["observation"], ["action"])
    critic = TensorDictModule(nn.Bilinear(17, 6, outputs), ["observation", "action"], ["state_action_value"])
    head = heads.Quantiles(25, drop=0) if outputs == 1 else None
    loss = losses.DDPGLoss(actor, critic, head=head)
    SoftUpdate(loss, tau=0.1)
    with pytest.raises(UserError, match="needs (25 outputs|one output) of each of the 1 critics, there are [15] of 1"):
        loss(batch(dtype=torch.float32))


def test_a_quantile_critic_s_target_is_its_own_atoms():
    # everywhere the quantiles (4, 0): sorted, the larger left out where drop=1: y = 1 + 0.5 * 0 or 1 + 0.5 * (0, 4)
    env = envs.make("Pendulum-v1")
    for drop, mean in ((1, 1.0), (0, 2.0)):
        critic = modules.q_value(env, 1, (), head=heads.Quantiles(2, drop=drop))
        last = critic.module.layers[-1]
        last.weight.data.zero_()
        last.bias.data[:, 0] = torch.tensor([[4.0, 0.0]])
        loss = losses.DDPGLoss(modules.deterministic_actor(env, (8,)), critic, gamma=0.5)
        SoftUpdate(loss, tau=0.1)
        rows = batch(4, 3, 1, torch.float32)
        rows["next", "reward"].fill_(1.0)
        rows["next", "terminated"].fill_(False)
        assert loss(rows)["target_value"] == mean


def test_settings_that_are_fixed_here_are_refused():
    env = envs.make("Pendulum-v1")
    for setting in ("num_qvalue_nets", "delay_qvalue"):
        with pytest.raises(TypeError, match=setting):
            losses.DDPGLoss(modules.deterministic_actor(env), modules.q_value(env, 1), **{setting: 1})
