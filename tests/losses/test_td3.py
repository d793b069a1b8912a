"""TD3's loss: values by hand, agreement with TorchRL's, gradients, smoothing, delay, refusals."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Composite, Unbounded
from torchrl.modules import ProbabilisticActor, TanhDelta
from torchrl.objectives import SoftUpdate
from torchrl.objectives import TD3Loss as TorchRLTD3Loss

from pgkit import collectors, data, envs, functional, losses, modules, updates
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
    def __init__(self, action):
        super().__init__()
        self.action = nn.Parameter(torch.tensor([action], dtype=torch.float64))

    def forward(self, observation):
        return self.action.expand(len(observation), 1)


class Twins(nn.Module):
    num_critics = 2

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([3.0, 2.0], dtype=torch.float64))

    def forward(self, observation, action):
        return observation * self.weight + action


def by_hand(**kwargs):
    actor = TensorDictModule(Constant(0.9), ["observation"], ["action"])
    critics = TensorDictModule(Twins(), ["observation", "action"], ["state_action_value"])
    loss = losses.TD3Loss(actor, critics, bounds=(-1.0, 1.0), gamma=0.5, **kwargs)
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
    # no noise: a' = 0.9, Q'(2, 0.9) = 6.9, 4.9: y = 1 + 0.5 * 4.9 = 3.45 (also where truncated), 1 where terminated
    # Q(1, 0.5) = 3.5, 2.5: errors 0.05, -0.95 twice and 2.5, 1.5: squares 0.905, 0.905, 8.5: mean 10.31 / 3
    # actor: -Q_1(1, 0.9) = -3.9, of the first critic, which is not the least
    loss, data = by_hand(policy_noise=0.0)
    out = loss(data)
    assert out["loss_qvalue"].item() == pytest.approx(10.31 / 3)
    assert out["loss_actor"].item() == pytest.approx(-3.9)
    assert out["next_state_value"].item() == pytest.approx(4.9)
    assert out["target_value"].item() == pytest.approx((3.45 + 3.45 + 1) / 3)
    assert out["pred_value"].item() == pytest.approx(3.0)
    torch.testing.assert_close(data["td_error"], torch.tensor([0.95, 0.95, 2.5], dtype=torch.float64))


def test_the_noise_is_clipped_and_so_is_the_smoothed_action():
    # noise of +-1000 clipped to +-0.5: a' is 0.4 or, bounded by 1, 1.0
    loss, data = by_hand(policy_noise=1e3, noise_clip=0.5)
    seen = {round(loss(data)["next_state_value"].item() * 3 - 12, 6) for _ in range(50)}  # sum of three a'
    assert seen <= {1.2, 1.8, 2.4, 3.0} and len(seen) > 1
    action = functional.smoothed_action(torch.zeros(2000, 2), 0.2, 0.5, -1.0, 1.0)
    assert action.abs().max() == 0.5 and action.std().item() == pytest.approx(0.2, abs=0.01)
    torch.manual_seed(0)
    noise = torch.randn(4, 2)
    torch.manual_seed(0)
    std, clip = torch.tensor([1.0, 0.1]), torch.tensor([0.3, 9.0])
    low, high = torch.tensor([-1.0, -0.05]), torch.tensor([1.0, 0.05])
    expected = torch.stack([noise[:, 0].clamp(-0.3, 0.3), (0.1 * noise[:, 1]).clamp(-0.05, 0.05)], -1)
    torch.testing.assert_close(functional.smoothed_action(torch.zeros(4, 2), std, clip, low, high), expected)


@pytest.mark.parametrize("distance", ["l2", "smooth_l1"])
@pytest.mark.parametrize("delay_actor", [True, False])
def test_agrees_with_torchrl(distance, delay_actor):
    env = envs.make("HalfCheetah-v5")
    actor = modules.deterministic_actor(env, (16,)).double()
    critics = [modules.q_value(env, 1, (16,)).double() for _ in range(2)]
    settings = {"action_spec": env.action_spec_unbatched, "loss_function": distance, "delay_actor": delay_actor}
    theirs = TorchRLTD3Loss(actor, critics, **settings).double()
    theirs.make_value_estimator(gamma=0.97)
    mine = losses.TD3Loss(actor, critics, gamma=0.97, **settings).double()
    for loss in (mine, theirs):
        SoftUpdate(loss, tau=0.1)
        torch.manual_seed(1)
        targets = [loss.target_qvalue_network_params, *([loss.target_actor_network_params] if delay_actor else [])]
        for x in [x for target in targets for x in target.values(True, True)]:
            x.data.add_(torch.randn_like(x) * 0.1)
    data = batch()
    results = []
    for loss in (mine, theirs):
        copy = data.copy()
        torch.manual_seed(0)
        out = loss(copy)
        params = [*actor.parameters(), *loss.qvalue_network_params.values(True, True)]
        results.append((out, copy["td_error"], torch.autograd.grad(out["loss_actor"] + out["loss_qvalue"], params)))
    (a, a_error, a_grads), (b, b_error, b_grads) = results
    for key in ("loss_actor", "loss_qvalue", "pred_value", "next_state_value", "target_value"):
        torch.testing.assert_close(a[key], b[key].mean())
    torch.testing.assert_close(a["state_action_value_actor"], b["state_action_value_actor"][0].mean())
    torch.testing.assert_close(a_error.square(), b_error)  # theirs is squared
    for x, y in zip(a_grads, b_grads, strict=True):
        torch.testing.assert_close(x, y)
    assert set(mine.out_keys) == set(theirs.out_keys) == set(a.keys())


def test_each_term_trains_its_own_parameters():
    env = envs.make("HalfCheetah-v5")
    actor, critics = modules.deterministic_actor(env, (8,)), modules.q_value(env, hidden=(8,))
    loss = losses.TD3Loss(actor, critics, action_spec=env.action_spec_unbatched)
    SoftUpdate(loss, tau=0.1)
    out = loss(batch(dtype=torch.float32))
    groups = {"loss_actor": [*actor.parameters()], "loss_qvalue": [*critics.parameters()]}
    for key in groups:
        for name, params in groups.items():
            grads = torch.autograd.grad(out[key], params, allow_unused=True, retain_graph=True)
            assert all((g is not None and bool(g.any())) == (name == key) for g in grads)


def test_importance_weights_scale_the_critics_loss():
    loss, data = by_hand(policy_noise=0.0)
    out = loss(data.set("priority_weight", torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))
    assert out["loss_qvalue"].item() == pytest.approx(8.5 / 3) and out["loss_actor"].item() == pytest.approx(-3.9)


def agent(compile="off", delay_targets=True, seed=0):
    torch.manual_seed(seed)
    env = envs.make("Pendulum-v1")
    actor = modules.deterministic_actor(env, (16,))
    loss = losses.TD3Loss(actor, modules.q_value(env, hidden=(16,)), action_spec=env.action_spec_unbatched, gamma=0.9)
    update = updates.OffPolicyUpdate(
        loss, data.ReplayBuffer(env, 500, seed=0), torch.optim.Adam(loss.parameters(), lr=1e-2), batch_size=32,
        learning_starts=64, actor_delay=2, delay_targets=delay_targets, tau=0.5, updates_per_step=0.15, compile=compile,
    )  # fmt: skip
    exploring = modules.GaussianExploration(actor, env)
    return update, collectors.VectorCollector(env, exploring, frames_per_batch=32)


def weights(update, *names):
    state = update.loss.state_dict()
    return torch.cat(
        [
            x.detach().flatten().float()
            for key, x in state.items()
            if isinstance(x, torch.Tensor) and key.startswith(names)
        ]
    )


@pytest.mark.parametrize("delay_targets", [True, False])
def test_targets_move_with_the_actor(delay_targets):
    update, collector = agent(delay_targets=delay_targets)
    for _ in range(2):
        update.buffer.extend(collector.rollout())
    moved = []
    for _ in range(4):
        before = [weights(update, name) for name in ("actor", "target_", "qvalue")]
        update.train(1)
        after = [weights(update, name) for name in ("actor", "target_", "qvalue")]
        moved.append(tuple(not torch.equal(x, y) for x, y in zip(before, after, strict=True)))
    assert moved == [(True, True, True), (False, not delay_targets, True)] * 2


def test_eager_equals_compiled():
    results = []
    for compile in ("off", "on"):
        update, collector = agent(compile)
        for _ in range(4):
            metrics = update(collector.rollout())
        results.append((weights(update, ""), metrics))
        assert (update.compile_seconds > 0) == (compile == "on")
    (a, eager), (b, compiled) = results
    torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)
    assert eager == pytest.approx(compiled, rel=1e-2, abs=1e-2)


def test_refusals():
    env = envs.make("Pendulum-v1")
    critics, spec = modules.q_value(env), env.action_spec_unbatched
    with pytest.raises(UserError, match="TD3Loss needs an actor that gives one action.*deterministic_actor"):
        losses.TD3Loss(modules.tanh_normal_actor(env), critics, action_spec=spec)
    with pytest.raises(UserError, match="action_spec= or bounds="):
        losses.TD3Loss(modules.deterministic_actor(env), critics)


def test_a_spec_may_be_the_actor_s_composite_and_must_have_bounds():
    env = envs.make("Pendulum-v1")
    actor, critics = modules.deterministic_actor(env), modules.q_value(env)
    loss = losses.TD3Loss(actor, critics, action_spec=Composite(action=env.action_spec_unbatched))
    assert loss.max_action == 2 and loss.min_action == -2
    vector = envs.make("Pendulum-v1", num_envs=3)
    loss = losses.TD3Loss(actor, critics, action_spec=vector.action_spec)
    assert loss.max_action.shape == (1,) and loss.max_action == 2
    with pytest.raises(UserError, match="must be Bounded"):
        losses.TD3Loss(actor, critics, action_spec=Unbounded(1))


def test_an_actor_whose_distribution_is_a_single_action_is_deterministic():
    env = envs.make("Pendulum-v1")
    net = TensorDictModule(nn.Linear(3, 1), in_keys=["observation"], out_keys=["param"])
    bounds = {"low": -2.0, "high": 2.0}
    actor = ProbabilisticActor(net, in_keys=["param"], distribution_class=TanhDelta, distribution_kwargs=bounds)
    critics = modules.q_value(env, 2, (8,))
    loss = losses.TD3Loss(actor, critics, action_spec=env.action_spec_unbatched)
    SoftUpdate(loss, tau=0.1)
    data = batch(obs=3, actions=1, dtype=torch.float32)
    out = loss(data)
    value = critics(TensorDict({"observation": data["observation"], "action": actor(data.copy())["action"]}, [32]))
    torch.testing.assert_close(out["loss_actor"], -value["state_action_value"][:, 0].mean())
    assert torch.autograd.grad(out["loss_actor"], net.module.weight)[0].any()


def test_importance_weights_with_a_trailing_1():
    (loss, data), weights = by_hand(), torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    results = []
    for weight in (weights, weights.unsqueeze(-1)):
        torch.manual_seed(0)
        results.append(loss(data.copy().set("priority_weight", weight))["loss_qvalue"])
    torch.testing.assert_close(*results)
