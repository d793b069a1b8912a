"""Discrete SAC's loss: values by hand, agreement with TorchRL's, Gumbel-Softmax, gradients, refusals."""

import math

import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.envs import GymEnv
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteSACLoss as TorchRLDiscreteSACLoss
from torchrl.objectives import SoftUpdate

from pgkit import collectors, controllers, data, envs, functional, losses, modules, updates
from pgkit.errors import UserError
from pgkit.losses.discrete_sac import _chosen
from tests.modules.test_discrete import Masked

FORMS = ["expectation", "gumbel_softmax"]


def batch(size=32, obs=4, actions=2, one_hot=False, dtype=torch.float64):
    action = torch.randint(actions, (size,))
    return TensorDict(
        {
            "observation": torch.randn(size, obs, dtype=dtype),
            "action": nn.functional.one_hot(action, actions) if one_hot else action,
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
    """Logits (0, log 3): probabilities 1/4 and 3/4 everywhere."""

    def __init__(self):
        super().__init__()
        self.logits = nn.Parameter(torch.tensor([0.0, math.log(3)], dtype=torch.float64))

    def forward(self, observation):
        return self.logits.expand(len(observation), 2)


class Twins(nn.Module):
    """Q_1(s, .) = (4 s, 8 s), Q_2(s, .) = (6 s, 2 s): the least is (4 s, 2 s)."""

    num_critics = 2

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([[4.0, 8.0], [6.0, 2.0]], dtype=torch.float64))

    def forward(self, observation):
        return observation.unsqueeze(-1) * self.weight


def by_hand(**kwargs):
    actor = ProbabilisticActor(
        TensorDictModule(Constant(), ["observation"], ["logits"]), in_keys=["logits"],
        distribution_class=Categorical, return_log_prob=True,
    )  # fmt: skip
    critics = TensorDictModule(Twins(), ["observation"], ["action_value"])
    loss = losses.DiscreteSACLoss(actor, critics, gamma=0.5, **kwargs)
    SoftUpdate(loss, tau=0.1)
    number = lambda *x: torch.tensor(x, dtype=torch.float64).unsqueeze(-1)  # noqa: E731
    data = TensorDict(
        {
            "observation": number(1, 1, 1),
            "action": torch.tensor([0, 1, 1]),
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


ENTROPY = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))


def test_values_by_hand():
    # V(s') = 1/4 * 8 + 3/4 * 4 + 0.1 H = 5 + 0.1 H: y = 1 + 0.5 V(s') (also where truncated), 1 where terminated
    # Q(1, a): (4, 6), (8, 2), (8, 2); actor: -V(1) = -(1/4 * 4 + 3/4 * 2 + 0.1 H) = -(2.5 + 0.1 H)
    # temperature: -log(0.1) (-H + H_target), H_target = 0.98 log 2
    loss, data = by_hand(alpha_init=0.1)
    out = loss(data)
    y = 1 + 0.5 * (5 + 0.1 * ENTROPY)
    squares = [(4 - y) ** 2 + (6 - y) ** 2, (8 - y) ** 2 + (2 - y) ** 2, 49 + 1]
    assert out["loss_qvalue"].item() == pytest.approx(sum(squares) / 3, rel=1e-6)
    assert out["loss_actor"].item() == pytest.approx(-(2.5 + 0.1 * ENTROPY), rel=1e-6)
    assert out["entropy"].item() == pytest.approx(ENTROPY, rel=1e-6)
    assert out["loss_alpha"].item() == pytest.approx(-math.log(0.1) * (0.98 * math.log(2) - ENTROPY), rel=1e-5)
    known = by_hand(alpha_init=0.1, num_actions=2)[0]
    assert known.target_entropy.item() == pytest.approx(0.98 * math.log(2))
    assert known(data.copy())["loss_alpha"] == out["loss_alpha"]  # the same as read off the batch
    torch.testing.assert_close(
        data["td_error"], torch.tensor([6 - y, 8 - y, 7], dtype=torch.float64), rtol=1e-6, atol=0
    )
    weighted = loss(data.set("priority_weight", torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))
    assert weighted["loss_qvalue"].item() == pytest.approx(50 / 3)


def test_gumbel_softmax_by_hand():
    # alpha 0: each state's value is that of the drawn action, 4 or 2 (next: 8 or 4), the first in a quarter of draws
    torch.manual_seed(0)
    loss, data = by_hand(temperature=controllers.FixedTemperature(0.0), form="gumbel_softmax")
    big = data[:1].expand(4000)
    out = loss(big.clone())
    assert out["loss_actor"].item() == pytest.approx(-2.5, abs=0.05)  # the expectation, in the mean
    single = [loss(data[:1].clone()) for _ in range(40)]
    assert {round(x["loss_actor"].item(), 6) for x in single} == {-4.0, -2.0}
    # the first critic's error Q(1, 0) - y = 4 - (1 + 0.5 * 8) or 4 - (1 + 0.5 * 4), the second's 6 - y: squares 2 or 10
    assert {round(x["loss_qvalue"].item(), 6) for x in single} == {2.0, 10.0}
    grad = torch.autograd.grad(out["loss_actor"], list(loss.actor_network_params.values(True, True)))[0]
    assert grad[0] < 0 < grad[1]  # action 0 is worth more: its logit rises


def test_straight_through_samples_are_one_hot_forward_and_relaxed_backward():
    torch.manual_seed(0)
    logits = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64).expand(20_000, 3).clone().requires_grad_()
    sample = functional.straight_through_sample(logits, 0.7)
    assert ((sample == 0) | (sample.sub(1).abs() < 1e-12)).all()
    torch.testing.assert_close(sample.sum(-1), torch.ones(20_000, dtype=torch.float64))
    torch.testing.assert_close(sample.mean(0), logits[0].softmax(-1), atol=0.015, rtol=0)
    # the gradient is that of softmax((logits + g) / tau) at the same noise: y (c - sum(c y)) / tau
    coefficient = torch.tensor([1.0, 2.0, 5.0], dtype=torch.float64)
    grad = torch.autograd.grad((sample * coefficient).sum(), logits)[0]
    torch.manual_seed(0)
    gumbel = -torch.empty_like(logits).exponential_().log()
    y = ((logits + gumbel) / 0.7).softmax(-1)
    assert (y.argmax(-1) == sample.argmax(-1)).all()
    torch.testing.assert_close(grad, y * (coefficient - (coefficient * y).sum(-1, keepdim=True)) / 0.7)


@pytest.mark.parametrize("one_hot", [False, True])
@pytest.mark.parametrize("distance", ["l2", "smooth_l1"])
def test_agrees_with_torchrl(one_hot, distance):
    env = GymEnv("CartPole-v1", categorical_action_encoding=not one_hot)
    actor = modules.categorical_actor(env, (16,)).double()
    singles = [TensorDictModule(modules.mlp(4, 2, (16,)), ["observation"], ["action_value"]).double() for _ in range(2)]
    settings = {"loss_function": distance, "alpha_init": 0.3, "num_actions": 2, "target_entropy_weight": 0.7}
    space = "one-hot" if one_hot else "categorical"
    theirs = TorchRLDiscreteSACLoss(actor, singles, action_space=space, **settings)
    theirs.make_value_estimator(gamma=0.97)
    mine = losses.DiscreteSACLoss(actor, singles, action_space=space, gamma=0.97, **settings)
    for loss in (mine, theirs):
        SoftUpdate(loss, tau=0.1)
        loss.double()
        torch.manual_seed(1)
        for x in loss.target_qvalue_network_params.values(True, True):
            x.data.add_(torch.randn_like(x) * 0.1)
    data = batch(one_hot=one_hot)
    results = []
    for loss in (mine, theirs):
        copy = data.copy()
        out = loss(copy)
        total = sum(out[key] for key in ("loss_actor", "loss_qvalue", "loss_alpha"))
        params = [*actor.parameters(), *loss.qvalue_network_params.values(True, True), loss.log_alpha]
        results.append((out, copy["td_error"], torch.autograd.grad(total, params)))
    (a, a_error, a_grads), (b, b_error, b_grads) = results
    for key in theirs.out_keys:
        torch.testing.assert_close(a[key], b[key])
    torch.testing.assert_close(a_error, b_error)
    for x, y in zip(a_grads, b_grads, strict=True):
        torch.testing.assert_close(x, y)


@pytest.mark.parametrize("form", FORMS)
def test_each_term_trains_its_own_parameters(form):
    env = envs.make("CartPole-v1")
    actor, critics = modules.categorical_actor(env, (8,)), modules.discrete_q_value(env, hidden=(8,))
    loss = losses.DiscreteSACLoss(actor, critics, form=form)
    SoftUpdate(loss, tau=0.1)
    out = loss(batch(dtype=torch.float32))
    groups = {
        "loss_actor": [*actor.parameters()],
        "loss_qvalue": [*critics.parameters()],
        "loss_alpha": [loss.log_alpha],
    }
    for key in groups:
        for name, params in groups.items():
            grads = torch.autograd.grad(out[key], params, allow_unused=True, retain_graph=True)
            assert all((g is not None and bool(g.any())) == (name == key) for g in grads)


def test_a_forbidden_action_costs_nothing_and_breaks_nothing():
    log_prob = torch.tensor([[0.0, -torch.inf]]).log_softmax(-1).clamp_min(torch.finfo(torch.float32).min)
    value = functional.expected_soft_value(log_prob.exp(), log_prob, torch.tensor([[2.0, 9.0]]), 0.5)
    assert value.item() == 2.0


@pytest.mark.parametrize("form", FORMS)
def test_a_forbidden_action_stays_harmless_at_any_temperature(form):
    torch.manual_seed(0)
    env = envs.make(Masked, num_envs=4, seed=1, flatten=False)
    actor = modules.categorical_actor(env, hidden=(8,))
    critics = TensorDictModule(modules.mlp(3, 4, (8,)), ["observation"], ["action_value"])
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=64, compile="off").rollout().reshape(-1)
    loss = losses.DiscreteSACLoss(actor, [critics], alpha_init=30.0, form=form)
    SoftUpdate(loss, tau=0.1)
    out = loss(rollout)
    assert all(value.isfinite() for value in out.values())
    grads = torch.autograd.grad(out["loss_actor"], [x for x in loss.actor_network_params.values(True, True)])
    assert all(grad.isfinite().all() for grad in grads)


@pytest.mark.parametrize(("form", "one_hot"), list(zip(FORMS, [False, True], strict=True)))
def test_trains_on_replayed_actions_eager_as_compiled(form, one_hot):
    results = []
    for compile in ("off", "on"):
        torch.manual_seed(0)
        env = GymEnv("CartPole-v1") if one_hot else envs.make("CartPole-v1", num_envs=2)
        actor, critics = modules.categorical_actor(env, (16,)), modules.discrete_q_value(env, hidden=(16,))
        loss = losses.DiscreteSACLoss(actor, critics, form=form, gamma=0.9)
        update = updates.OffPolicyUpdate(
            loss, data.ReplayBuffer(env, 500, seed=0), torch.optim.Adam(loss.parameters(), lr=1e-2), batch_size=32,
            learning_starts=64, updates_per_step=0.15, compile=compile,
        )  # fmt: skip
        if one_hot:
            env.set_seed(0)
            rollouts = [env.rollout(64, actor, break_when_any_done=False) for _ in range(4)]
        else:
            collector = collectors.VectorCollector(env, actor, frames_per_batch=64)
            rollouts = (collector.rollout() for _ in range(4))
        for rollout in rollouts:
            metrics = update(rollout)
        results.append((torch.cat([p.detach().flatten() for p in loss.parameters()]), metrics))
        assert (update.compile_seconds > 0) == (compile == "on")
    (a, eager), (b, compiled) = results
    torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)
    assert eager == pytest.approx(compiled, rel=1e-2, abs=1e-2)


def test_a_list_of_one_critic_is_that_critic():
    env = envs.make("CartPole-v1")
    actor = modules.categorical_actor(env, (8,))
    single = TensorDictModule(modules.mlp(4, 2, (8,)), ["observation"], ["action_value"])
    loss = losses.DiscreteSACLoss(actor, [single])
    SoftUpdate(loss, tau=0.1)
    data = batch(dtype=torch.float32)
    q = single(data.copy())["action_value"].gather(-1, data["action"].unsqueeze(-1))
    assert loss(data)["q_value"].item() == pytest.approx(q.mean().item()) and loss.num_critics == 1


def test_refusals():
    env = envs.make("CartPole-v1")
    with pytest.raises(UserError, match="DiscreteSACLoss needs an actor over discrete actions.*TanhNormal"):
        losses.DiscreteSACLoss(modules.tanh_normal_actor(envs.make("Pendulum-v1")), modules.discrete_q_value(env))
    with pytest.raises(ValueError, match="form is 'expectation' or 'gumbel_softmax', not 'sampled'"):
        losses.DiscreteSACLoss(modules.categorical_actor(env), modules.discrete_q_value(env), form="sampled")
    with pytest.raises(UserError, match="discrete_q_value needs one discrete action.*modules.q_value"):
        modules.discrete_q_value(envs.make("Pendulum-v1"))


def test_several_discrete_actions_at_once_are_refused():
    env = envs.make(lambda: Masked(spaces.MultiDiscrete([2, 2])), flatten=False)
    actor = modules.categorical_actor(env)
    with pytest.raises(UserError, match="takes one discrete action, this actor draws MultiCategorical ones.*ClipPPO"):
        losses.DiscreteSACLoss(actor, modules.discrete_q_value(envs.make("CartPole-v1")))
    with pytest.raises(UserError, match="SACLoss needs an actor over continuous actions, this one is MultiCategorical"):
        losses.SACLoss(actor, modules.q_value(envs.make("Pendulum-v1")))


def test_the_target_entropy_comes_from_the_number_of_actions():
    env = envs.make("CartPole-v1", num_envs=2)
    networks = modules.categorical_actor(env, (8,)), modules.discrete_q_value(env, 2, (8,))
    for known in ({"num_actions": 2}, {"action_spec": env.action_spec_unbatched}):
        target = losses.DiscreteSACLoss(*networks, **known).target_entropy
        assert target.item() == pytest.approx(0.98 * math.log(2)) and target.dtype == torch.float64
    with pytest.raises(UserError, match="read off each batch"):
        _ = losses.DiscreteSACLoss(*networks).target_entropy


def test_indices_with_a_trailing_1_are_no_one_hot_actions():
    q, index = torch.arange(12.0).view(2, 2, 3), torch.tensor([2, 1])
    expected = torch.tensor([[2.0, 5.0], [7.0, 10.0]])
    one_hot = torch.nn.functional.one_hot(index, 3)
    for action in (index, index.unsqueeze(-1), one_hot):
        torch.testing.assert_close(_chosen(q, action), expected)


def test_a_list_of_single_critics_is_an_ensemble_of_them():
    env = envs.make("CartPole-v1")
    actor, singles = modules.categorical_actor(env, (8,)), [modules.discrete_q_value(env, 1, (8,)) for _ in range(3)]
    loss = losses.DiscreteSACLoss(actor, singles)
    SoftUpdate(loss, tau=0.1)
    data = batch(dtype=torch.float32)
    value = loss.action_values(data, loss.qvalue_network_params)
    expected = torch.cat([single(data.copy())["action_value"] for single in singles], 1)
    torch.testing.assert_close(value, expected)
    index = torch.tensor([2, 0])
    torch.testing.assert_close(loss.action_values(data, loss.qvalue_network_params, index), expected[:, index])
    assert loss(data)["loss_qvalue"] > 0


@pytest.mark.parametrize("given", [True, False])
def test_under_a_mask_the_target_entropy_is_that_of_the_allowed_actions(given):
    env = envs.make(Masked, num_envs=2, seed=1, flatten=False)  # two of four actions are allowed
    actor = modules.categorical_actor(env, (8,))
    temperature = controllers.Temperature(0.5 * math.log(4)) if given else None
    loss = losses.DiscreteSACLoss(
        actor, modules.discrete_q_value(env, hidden=(8,)), temperature=temperature, num_actions=4,
        target_entropy_weight=0.5, delay_qvalue=False,
    )  # fmt: skip
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=32).rollout().reshape(-1)
    log_alpha = loss.log_alpha if temperature is None else temperature.log_alpha
    with torch.no_grad():
        log_alpha.fill_(1.0)
    out = loss(rollout)
    torch.testing.assert_close(out["loss_alpha"], out["entropy"] - 0.5 * math.log(2))
