"""SAC's loss: values by hand, agreement with TorchRL's, gradients, target entropy, refusals."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss as TorchRLSACLoss
from torchrl.objectives import SoftUpdate

from pgkit import collectors, controllers, envs, heads, losses, modules
from pgkit.errors import UserError


def batch(size=32, obs=3, actions=1):
    return TensorDict(
        {
            "observation": torch.randn(size, obs),
            "action": torch.rand(size, actions) * 2 - 1,
            "next": {
                "observation": torch.randn(size, obs),
                "reward": torch.randn(size, 1),
                "done": torch.rand(size, 1) < 0.5,
                "terminated": torch.rand(size, 1) < 0.3,
            },
        },
        [size],
    )


class Fixed(nn.Module):
    """loc 0, a free scale; the critics are linear: everything below can be done by hand."""

    def __init__(self, scale):
        super().__init__()
        self.loc = nn.Parameter(torch.zeros(1, dtype=torch.float64))
        self.register_buffer("scale", torch.tensor([scale], dtype=torch.float64))

    def forward(self, observation):
        shape = (*observation.shape[:-1], 1)
        return self.loc.expand(shape), self.scale.expand(shape)


class Twins(nn.Module):
    num_critics = 2

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([2.0, 3.0], dtype=torch.float64))

    def forward(self, observation, action):
        return observation * self.weight + action


def by_hand(scale=1e-6, **kwargs):
    actor = ProbabilisticActor(
        TensorDictModule(Fixed(scale), ["observation"], ["loc", "scale"]), in_keys=["loc", "scale"],
        distribution_class=TanhNormal, distribution_kwargs={"event_dims": 1}, return_log_prob=True,
    )  # fmt: skip
    critics = TensorDictModule(Twins(), ["observation", "action"], ["state_action_value"])
    loss = losses.SACLoss(actor, critics, gamma=0.5, **kwargs)
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
    # scale -> 0, alpha 0: a' = 0, min Q'(2, 0) = 4; y = 1 + 0.5 * 4 = 3 (also where truncated), 1 where terminated
    # Q(1, 0.5) = 2.5, 3.5: errors -0.5, 0.5 | -0.5, 0.5 | 1.5, 2.5 -> squares 0.5, 0.5, 8.5: mean 9.5 / 3
    # actor: -min Q(1, 0) = -2
    loss, data = by_hand(temperature=controllers.FixedTemperature(0.0))
    out = loss(data)
    assert out["loss_qvalue"].item() == pytest.approx(9.5 / 3, abs=1e-5)
    assert out["loss_actor"].item() == pytest.approx(-2.0, abs=1e-5)
    torch.testing.assert_close(data["td_error"], torch.tensor([0.5, 0.5, 2.5], dtype=torch.float64), atol=1e-5, rtol=0)


def test_entropy_enters_target_actor_and_temperature_with_the_right_sign():
    # scale 1e-6 and u = scale * e near 0: log pi = -e²/2 - log(1e-6) - log(sqrt(2 pi)), about 12.4: its weight is alpha
    torch.manual_seed(0)
    loss, data = by_hand(alpha_init=0.1, target_entropy=-1.0)
    out = loss(data)
    log_prob = -out["entropy"].item()
    assert 8 < log_prob < 12.9
    assert out["loss_actor"].item() == pytest.approx(0.1 * log_prob - 2.0, abs=1e-4)
    # loss_alpha = -log(0.1) * (log_prob - 1)
    assert out["loss_alpha"].item() == pytest.approx(-math.log(0.1) * (log_prob - 1), abs=1e-4)
    # y falls by gamma * alpha * log pi where not terminated: the error of the first row rises from -0.5 by about 0.6
    assert data["td_error"][0] > 0.9 and data["td_error"][2].item() == pytest.approx(2.5, abs=1e-5)


@pytest.mark.parametrize("distance", ["l2", "smooth_l1"])
def test_agrees_with_torchrl(distance):
    env = envs.make("HalfCheetah-v5")
    actor = modules.tanh_normal_actor(env, (16,))
    critics = [modules.q_value(env, 1, (16,)) for _ in range(2)]
    theirs = TorchRLSACLoss(actor, critics, loss_function=distance, target_entropy=-6.0, alpha_init=0.3)
    theirs.make_value_estimator(gamma=0.97)
    mine = losses.SACLoss(actor, critics, loss_function=distance, alpha_init=0.3, gamma=0.97)
    for loss in (mine, theirs):
        SoftUpdate(loss, tau=0.1)
    for ours, other in zip(
        mine.target_qvalue_network_params.values(True, True),
        theirs.target_qvalue_network_params.values(True, True),
        strict=True,
    ):
        other.data.copy_(ours.data.add_(torch.randn_like(ours)))
    data = batch(obs=17, actions=6)
    results = []
    for loss in (mine, theirs):
        copy = data.copy()
        torch.manual_seed(0)
        out = loss(copy)
        total = sum(out[key] for key in ("loss_actor", "loss_qvalue", "loss_alpha"))
        params = [*actor.parameters(), *loss.qvalue_network_params.values(True, True), loss.log_alpha]
        results.append((out, copy["td_error"], torch.autograd.grad(total, params)))
    (a, a_error, a_grads), (b, b_error, b_grads) = results
    for key in ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy"):
        torch.testing.assert_close(a[key], b[key])
    torch.testing.assert_close(a_error, b_error)
    for x, y in zip(a_grads, b_grads, strict=True):
        torch.testing.assert_close(x, y)


def test_each_term_trains_its_own_parameters_and_an_ensemble_is_its_members():
    env = envs.make("Pendulum-v1")
    actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, hidden=(8,))
    loss = losses.SACLoss(actor, critics)
    SoftUpdate(loss, tau=0.1)
    out = loss(batch())
    groups = {
        "loss_actor": [*actor.parameters()],
        "loss_qvalue": [*critics.parameters()],
        "loss_alpha": [loss.log_alpha],
    }
    for term in groups:
        for owner, params in groups.items():
            grads = torch.autograd.grad(out[term], params, allow_unused=True, retain_graph=True)
            assert any(g is not None and g.any() for g in grads) == (term == owner), (term, owner)


@pytest.mark.parametrize(("name", "dimensions"), [("Pendulum-v1", 1), ("HalfCheetah-v5", 6), ("Humanoid-v5", 17)])
def test_target_entropy_is_minus_the_number_of_action_dimensions(name, dimensions):
    env = envs.make(name)
    obs = env.observation_spec_unbatched["observation"].shape[0]
    actor, critics = modules.tanh_normal_actor(env, (4,)), modules.q_value(env, hidden=(4,))
    known = losses.SACLoss(actor, critics, action_spec=env.action_spec_unbatched, alpha_init=0.5)
    assert known.target_entropy == -dimensions and known.target_entropy.dtype == torch.float64
    seen = losses.SACLoss(actor, critics, alpha_init=0.5)  # without the spec, each batch shows it
    with pytest.raises(UserError, match="read off each batch: give action_spec="):
        _ = seen.target_entropy
    rows, outs = batch(4, obs, dimensions), []
    for loss in (known, seen):
        SoftUpdate(loss, tau=0.1)
        torch.manual_seed(0)
        outs.append(loss(rows.copy()))
    torch.testing.assert_close(outs[0]["loss_alpha"], outs[1]["loss_alpha"])
    torch.testing.assert_close(outs[0]["loss_alpha"], -math.log(0.5) * (-outs[0]["entropy"] - dimensions))
    with pytest.raises(UserError, match="read off each batch"):  # a batch leaves no trace in the loss
        _ = seen.target_entropy


def test_importance_weights_scale_the_critics_loss():
    loss, data = by_hand(temperature=controllers.FixedTemperature(0.0))
    out = loss(data.set("priority_weight", torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))
    assert out["loss_qvalue"].item() == pytest.approx(8.5 / 3, abs=1e-5)


def test_gamma_has_one_owner_and_torchrl_s_way_of_setting_it_works():
    loss, data = by_hand(temperature=controllers.FixedTemperature(0.0))
    loss.make_value_estimator(gamma=0.25)  # y = 1 + 0.25 * 4 = 2: errors 0.5, 1.5 -> 2.5, 2.5, 8.5
    assert loss(data)["loss_qvalue"].item() == pytest.approx(13.5 / 3, abs=1e-5)


def test_a_discrete_actor_is_refused():
    actor = modules.categorical_actor(envs.make("CartPole-v1"))
    critics = modules.q_value(envs.make("Pendulum-v1"))
    with pytest.raises(UserError, match=r"Categorical.*categorical_actor.*DiscreteSACLoss"):
        losses.SACLoss(actor, critics)


def test_a_single_critic_with_a_head_has_outputs_and_not_critics():
    env = envs.make("Pendulum-v1")
    actor = modules.deterministic_actor(env, (8,))
    net = TensorDictModule(Joined(5), in_keys=["observation", "action"], out_keys=["state_action_value"])
    loss = losses.DDPGLoss(actor, net, head=heads.Quantiles(5, 0))
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=16).rollout().reshape(-1)
    assert loss.outputs(rollout, rollout["action"], loss.qvalue_network_params).shape == (16, 1, 5)
    several = [modules.q_value(env, 1, (8,), head=heads.Quantiles(5, 1)) for _ in range(2)]
    stochastic = modules.tanh_normal_actor(env, (8,))
    loss = losses.TQCLoss(stochastic, several)
    SoftUpdate(loss, tau=0.1)
    assert loss.head == heads.Quantiles(5, 1)
    assert loss.outputs(rollout, rollout["action"], loss.qvalue_network_params).shape == (16, 2, 5)
    assert loss(rollout)["loss_qvalue"] > 0


class Joined(torch.nn.Module):
    """A critic of one's own, ``[*B, outputs]``."""

    def __init__(self, outputs):
        super().__init__()
        self.net = torch.nn.Linear(4, outputs)

    def forward(self, observation, action):
        return self.net(torch.cat([observation, action], -1))


@pytest.mark.parametrize("loss", [losses.TD3Loss, losses.DDPGLoss])
def test_a_distance_has_one_owner(loss):
    env = envs.make("Pendulum-v1")
    actor = modules.deterministic_actor(env, (8,))
    settings = {"action_spec": env.action_spec_unbatched} if loss is losses.TD3Loss else {}
    number = 2 if settings else 1
    assert loss(actor, modules.q_value(env, number, (8,)), head=heads.Scalar("l1"), **settings).head.distance == "l1"
    assert loss(actor, modules.q_value(env, number, (8,)), loss_function="l1", **settings).head.distance == "l1"
    quantiles = modules.q_value(env, number, (8,), head=heads.Quantiles(5, 1))
    with pytest.raises(UserError, match="loss_function='l1' is for critics without a head"):
        loss(actor, quantiles, loss_function="l1", **settings)


def test_the_target_entropy_of_an_environment_s_composite_spec():
    env = envs.make("Pendulum-v1", num_envs=3)
    actor, critics = modules.tanh_normal_actor(env), modules.q_value(env)
    for spec in (env.full_action_spec, env.full_action_spec_unbatched, env.action_spec):
        assert losses.SACLoss(actor, critics, action_spec=spec).target_entropy == -1


def test_the_temperature_has_one_owner_and_torchrl_s_names():
    env = envs.make("Pendulum-v1")
    actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, hidden=(8,))
    loss = losses.SACLoss(actor, critics, alpha_init=0.3, target_entropy=-2.0, min_alpha=0.2, max_alpha=0.4)
    assert isinstance(loss.temperature, controllers.Temperature) and loss.log_alpha is loss.temperature.log_alpha
    assert next(iter(dict(loss.named_parameters()))) == "log_alpha"  # first and once, as before it was a block's
    assert loss.target_entropy == loss.temperature.target_entropy == -2
    loss.log_alpha.data.fill_(5.0)
    assert loss.alpha.item() == pytest.approx(0.4)
    fixed = losses.SACLoss(actor, critics, alpha_init=0.3, fixed_alpha=True)
    assert fixed.alpha.item() == pytest.approx(0.3, abs=1e-15) and fixed.log_alpha is fixed.temperature.log_alpha
    assert not [name for name, _ in fixed.named_parameters() if "alpha" in name]
    fixed.float().log_alpha.fill_(1.0)
    assert fixed.alpha.item() == pytest.approx(math.e)


@pytest.mark.parametrize("fixed", [False, True])
def test_a_state_from_before_the_temperature_was_a_block_is_loaded(fixed):
    env = envs.make("Pendulum-v1")
    make = lambda: losses.SACLoss(  # noqa: E731
        modules.tanh_normal_actor(env, (8,)), modules.q_value(env, hidden=(8,)), fixed_alpha=fixed, alpha_init=0.5
    )
    loss, state = make(), make().state_dict()
    old = {name: x for name, x in state.items() if not name.startswith("temperature.")} | {
        "log_alpha": torch.tensor(-2.0)
    }
    loss.load_state_dict(old)
    assert loss.alpha.item() == pytest.approx(math.exp(-2))
    loss.load_state_dict(state)
    assert loss.alpha.item() == pytest.approx(0.5)


def test_a_coefficient_is_exact_in_a_float64_agent():
    loss, _ = by_hand(temperature=controllers.FixedTemperature(0.1))
    loss.make_value_estimator(gamma=0.97)
    assert loss.gamma.item() == 0.97 and loss.alpha.item() == 0.1
    rows = batch(8).double()
    rows["next", "done"], rows["next", "terminated"] = (rows["next", key].bool() for key in ("done", "terminated"))
    steps = torch.full((8, 1), 3)
    one = heads.Returns.certain(torch.ones(8, dtype=torch.float64))
    target = loss.target(rows.set("steps_to_next_obs", steps), one).mean
    expected = rows["next", "reward"] + 0.97**3 * (~rows["next", "terminated"]).double()
    torch.testing.assert_close(target, expected.squeeze(-1), rtol=0, atol=1e-15)
    rows = batch(8).set("steps_to_next_obs", steps)
    assert loss.target(rows, heads.Returns.certain(torch.ones(8))).dtype == torch.float32


def test_augmented_copies_share_the_mean_of_their_targets_and_the_actor_takes_the_first():
    # two copies of one row: next observations 2 and 4, a' = 0, min Q' = 4 and 8: y = 1 + 0.5 * (4 + 8) / 2 = 4 for both
    # observations 1 and 3, a = 0.5: Q = 2.5, 3.5 and 6.5, 9.5: squares 2.25 + 0.25 and 6.25 + 30.25, mean 19.5
    # the actor sees the first copy: -min Q(1, 0) = -2
    loss, data = by_hand(temperature=controllers.FixedTemperature(0.0), augmented=True)
    row, other = data[:1], data[:1].clone()
    other["observation"], other["next", "observation"] = other["observation"] + 2, other["next", "observation"] + 2
    both = torch.stack([row, other])
    out = loss(both)
    assert out["loss_qvalue"].item() == pytest.approx(19.5, abs=1e-4)
    assert out["loss_actor"].item() == pytest.approx(-2.0, abs=1e-5)
    torch.testing.assert_close(both["td_error"], torch.tensor([[1.5], [5.5]], dtype=torch.float64), atol=1e-4, rtol=0)
    numbers = loss.target(both, torch.tensor([[4.0], [8.0]], dtype=torch.float64))  # a loss of one's own, without heads
    assert numbers.tolist() == [[4.0], [4.0]]
    apart = by_hand(temperature=controllers.FixedTemperature(0.0))[0](both.clone())  # y = 3 and 5
    assert apart["loss_qvalue"].item() == pytest.approx((0.5 + 2.25 + 20.25) / 2, abs=1e-4)


def test_the_terms_of_a_composite_action_are_those_of_its_one_part():
    env = envs.make("Pendulum-v1")
    plain = losses.SACLoss(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 2, (8,)), target_entropy=-1.0)
    net = plain.actor_network[0]  # pyright: ignore[reportIndexIssue]
    keys = [("params", "torque", "loc"), ("params", "torque", "scale")]
    net = TensorDictModule(net.module, net.in_keys, keys)
    kwargs = {"distribution_map": {"torque": TanhNormal}, "extra_kwargs": {"torque": {"low": -2.0, "high": 2.0}}}
    actor = ProbabilisticActor(
        net, in_keys=["params"], out_keys=["action"], distribution_class=CompositeDistribution,
        distribution_kwargs=kwargs, return_log_prob=True,
    )  # fmt: skip

    class Critics(nn.Module):
        num_critics = 2

        def __init__(self):
            super().__init__()
            self.net = plain.qvalue_network.module

        def forward(self, observation, action):
            return self.net(observation, action["torque"])

    critics = TensorDictModule(Critics(), ["observation", "action"], ["state_action_value"])
    parts = losses.SACLoss(actor, critics)  # -1, read off the action's parts
    rows = batch(8)
    results = []
    for loss in (plain, parts):
        SoftUpdate(loss, tau=0.1)
        torch.manual_seed(0)
        results.append(loss(rows.copy()))
        rows["action"] = TensorDict({"torque": rows["action"]}, [8])
    for key in ("loss_actor", "loss_qvalue", "loss_alpha", "entropy"):
        torch.testing.assert_close(results[1][key], results[0][key])
