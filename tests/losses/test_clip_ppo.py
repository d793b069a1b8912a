from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import nn
from torch.testing import assert_close
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss as TorchRLClipPPOLoss
from torchrl.objectives.utils import ValueEstimators

from pgkit import advantages, envs, functional, losses, modules, updates


def make_batch(actor, env, rows=32):
    torch.manual_seed(1)
    batch = TensorDict({"observation": torch.randn(rows, *env.observation_spec_unbatched["observation"].shape)}, [rows])
    batch = actor(batch).detach()
    batch["action_log_prob"] += 0.3 * torch.randn(rows)
    batch["advantage"], batch["value_target"] = torch.randn(rows, 1) + 0.5, torch.randn(rows, 1)
    batch["state_value"] = torch.randn(rows, 1)
    return batch


@pytest.fixture(params=["Pendulum-v1", "CartPole-v1"])
def agent(request):
    torch.manual_seed(0)
    env = envs.make(request.param)
    build = modules.gaussian_actor if request.param == "Pendulum-v1" else modules.categorical_actor
    actor, critic = build(env), modules.state_value(env)
    return env, actor, critic


@pytest.mark.parametrize(
    "kwargs",
    [
        {"clip_epsilon": 0.1, "entropy_coeff": 0.01},
        {"clip_epsilon": (0.1, 0.3), "normalize_advantage": True},
        {"clip_value": 0.2, "critic_coeff": 0.5, "loss_critic_type": "l2"},
        {"clip_value": True, "loss_critic_type": "smooth_l1", "reduction": "sum"},
        {"entropy_bonus": False},
    ],
)
def test_agrees_with_torchrl(agent, kwargs):
    env, actor, critic = agent
    batch = make_batch(actor, env)
    settings = {"normalize_advantage": False, "entropy_coeff": 0.0, "loss_critic_type": "l2"} | kwargs
    mine, theirs = (
        losses.ClipPPOLoss(actor, critic, **settings),
        TorchRLClipPPOLoss(actor, critic, **settings),
    )
    a, b = mine(batch), theirs(batch.copy())
    shared = [key for key in a.keys() if key in b.keys()]
    assert {"loss_objective", "loss_critic", "clip_fraction", "explained_variance"} <= set(shared)
    for key in shared:
        torch.testing.assert_close(a[key].squeeze(), b[key].squeeze(), rtol=1e-4, atol=1e-5, msg=key)
    parameters = [*actor.parameters(), *critic.parameters()]
    totals = [sum(v.sum() for k, v in out.items() if k.startswith("loss_")) for out in (a, b)]
    gradients = [torch.autograd.grad(total, parameters) for total in totals]
    for g, h in zip(*gradients, strict=True):
        torch.testing.assert_close(g, h, rtol=1e-3, atol=1e-5)


def test_by_hand(agent):
    # all ratios are 1: objective = mean advantage (not normalized), no clipping, no divergence
    env, actor, critic = agent
    batch = make_batch(actor, env)
    batch["action_log_prob"] = actor.get_dist(batch.copy()).log_prob(batch["action"]).detach()
    out = losses.ClipPPOLoss(actor, critic, normalize_advantage=False, critic_coeff=0.5)(batch)
    assert out["loss_objective"].item() == pytest.approx(-batch["advantage"].mean().item(), abs=1e-6)
    value = critic(batch.copy())["state_value"]
    expected = 0.5 * (value - batch["value_target"]).square().mean()
    assert out["loss_critic"].item() == pytest.approx(expected.item(), rel=1e-5)
    assert out["approx_kl"].item() == pytest.approx(0, abs=1e-6) and out["clip_fraction"].item() == 0


def test_surrogate_is_maximized_and_gets_the_normalized_advantage(agent):
    env, actor, critic = agent
    batch, seen = make_batch(actor, env), {}

    def surrogate(log_ratio, advantage):
        seen.update(log_ratio=log_ratio, advantage=advantage)
        return log_ratio.exp() * advantage

    out = losses.ClipPPOLoss(actor, critic, surrogate=surrogate)(batch)
    assert seen["advantage"].mean().item() == pytest.approx(0, abs=1e-6)
    assert seen["advantage"].std().item() == pytest.approx(1, abs=1e-5)
    expected = -(seen["log_ratio"].exp() * seen["advantage"]).mean()
    assert out["loss_objective"].item() == pytest.approx(expected.item(), rel=1e-5)
    with pytest.raises(ValueError, match="surrogate has shape"):
        losses.ClipPPOLoss(actor, critic, surrogate=lambda r, a: (r * a).mean())(batch)


def test_the_batch_is_left_as_it_was(agent):
    env, actor, critic = agent
    batch = make_batch(actor, env)
    before = batch.clone()
    losses.ClipPPOLoss(actor, critic)(batch)
    assert set(batch.keys()) == set(before.keys()) and (batch == before).all()


def test_missing_advantage_and_wrong_shapes(agent):
    env, actor, critic = agent
    loss, batch = losses.ClipPPOLoss(actor, critic), make_batch(actor, env)
    with pytest.raises(KeyError, match="the batch has no 'advantage'.*advantages.GAE"):
        loss(batch.exclude("advantage"))
    with pytest.raises(ValueError, match=r"advantage has shape \(32,\) but log_ratio has shape \(32, 1\)"):
        loss(batch.copy().set("advantage", batch["advantage"].squeeze(-1)))
    with pytest.raises(ValueError, match=r"old_log_prob has shape \(32, 1\) but log_prob has shape \(32,\)"):
        loss(batch.copy().set("action_log_prob", batch["action_log_prob"].unsqueeze(-1)))
    with pytest.raises(ValueError, match=r"target has shape \(32,\)"):
        loss(batch.copy().set("value_target", batch["value_target"].squeeze(-1)))


def test_torchrl_plumbing(agent):
    env, actor, critic = agent
    loss, batch = losses.ClipPPOLoss(actor, critic, normalize_advantage=False), make_batch(actor, env)
    assert loss.make_value_estimator(ValueEstimators.GAE, gamma=0.9, lmbda=0.8) is loss
    expected = loss(batch)["loss_objective"]
    loss.set_keys(advantage="my_advantage")
    renamed = batch.rename_key_("advantage", "my_advantage")
    torch.testing.assert_close(loss(renamed)["loss_objective"], expected)
    loss.set_keys(advantage="advantage")
    renamed.rename_key_("my_advantage", "advantage")
    given = {key: batch[key] for key in loss.in_keys if key in batch.keys(True)}
    values = loss(**given)  # @dispatch: tensors in, tuple out
    torch.testing.assert_close(values[loss.out_keys.index("loss_objective")], expected)
    loss.entropy_coeff = 0.5
    assert loss.entropy_coeff.item() == 0.5 and isinstance(loss.entropy_coeff, torch.Tensor)


def test_clip_epsilon_is_a_buffer_under_torchrl_s_names(agent):
    env, actor, critic = agent
    batch = make_batch(actor, env)
    one, two = losses.ClipPPOLoss(actor, critic), losses.ClipPPOLoss(actor, critic, clip_epsilon=(0.1, 0.3))
    assert {"clip_epsilon"} == {name for name, _ in one.named_buffers() if name.startswith("clip_epsilon")}
    assert two.clip_epsilon_low.item() == pytest.approx(0.1) and two.clip_epsilon_high.item() == pytest.approx(0.3)
    expected = losses.ClipPPOLoss(actor, critic, clip_epsilon=0.05)(batch)
    one.clip_epsilon = 0.05  # what a schedule does
    two.clip_epsilon_low = two.clip_epsilon_high = 0.05
    for loss in (one, two):
        out = loss(batch)
        assert out["loss_objective"] == expected["loss_objective"] and out["clip_fraction"] == expected["clip_fraction"]


def test_samples_mc_entropy_averages_draws(agent):
    # a distribution without a closed form: the mean of n draws of -log p has a deviation smaller by sqrt(n)
    from torchrl.modules import TanhNormal

    dist = TanhNormal(torch.zeros(4000, 1), torch.ones(4000, 1), event_dims=1)
    deviations = []
    for samples in (1, 16):
        loss = losses.ClipPPOLoss(agent[1], agent[2], samples_mc_entropy=samples)
        torch.manual_seed(0)
        deviations.append(loss.entropy(dist).std().item())
    assert deviations[0] / deviations[1] == pytest.approx(4.0, rel=0.1)


def composite_actor():
    parts = {"steer": torch.distributions.Normal, "gear": torch.distributions.Categorical}
    names = {"steer": ("action", "steer"), "gear": ("action", "gear")}
    net = nn.Linear(3, 5)

    class Parameters(nn.Module):
        def forward(self, observation):
            out = net(observation)
            return out[..., 0], out[..., 1].exp(), out[..., 2:]

    keys = [("params", "steer", "loc"), ("params", "steer", "scale"), ("params", "gear", "logits")]
    actor = ProbabilisticActor(
        TensorDictModule(Parameters(), ["observation"], keys),
        in_keys=["params"],
        out_keys=list(names.values()),
        distribution_class=partial(CompositeDistribution, distribution_map=parts, name_map=names),
        return_log_prob=True,
    )
    return actor, keys, actor(TensorDict({"observation": torch.randn(8, 3)}, [8])).detach()


def test_a_composite_action_is_scored_by_the_sum_of_its_parts():
    actor, keys, batch = composite_actor()
    batch["advantage"] = torch.randn(8, 1)
    log_probs = [("action", "steer_log_prob"), ("action", "gear_log_prob")]
    loss = losses.ClipPPOLoss(actor, normalize_advantage=False, entropy_coeff=0.1)
    assert {*log_probs, ("action", "steer"), ("action", "gear")} <= set(loss.in_keys)
    for key in log_probs:
        batch[key] = batch[key] - 0.05
    out = loss(batch)
    ratio = torch.tensor(0.1).exp()  # both parts' log-probabilities rose by 0.05
    torch.testing.assert_close(out["loss_objective"], -(ratio * batch["advantage"]).mean())
    steer = torch.distributions.Normal(batch[keys[0]], batch[keys[1]])
    gear = torch.distributions.Categorical(logits=batch[keys[2]])
    torch.testing.assert_close(out["entropy"], (steer.entropy() + gear.entropy()).mean())


def test_unreduced_losses_have_the_batch_s_shape(agent):
    env, actor, critic = agent
    batch = make_batch(actor, env)
    out = losses.ClipPPOLoss(actor, critic, entropy_coeff=0.1, reduction="none")(batch)
    whole = losses.ClipPPOLoss(actor, critic, entropy_coeff=0.1)(batch)
    for key in ("loss_objective", "loss_critic", "loss_entropy"):
        assert out[key].shape == batch.shape
        torch.testing.assert_close(out[key].mean(), whole[key])


def test_a_composite_action_in_an_update_and_in_vtrace():
    actor, _, batch = composite_actor()
    after = {"observation": batch["observation"].roll(-1, 0), "reward": torch.ones(8, 1)}
    batch["next"] = after | dict.fromkeys(("done", "terminated"), torch.zeros(8, 1, dtype=torch.bool))
    critic = TensorDictModule(nn.Linear(3, 1), ["observation"], ["state_value"])
    parameters = [*actor.parameters(), *critic.parameters()]
    for block in (advantages.GAE(critic), advantages.VTrace(critic, actor)):
        update = updates.OnPolicyUpdate(
            losses.ClipPPOLoss(actor, critic), block, torch.optim.SGD(parameters, lr=0.0), epochs=1, compile="off"
        )
        metrics = update(batch.clone())
        assert metrics["approx_kl"] == pytest.approx(0, abs=1e-6) and metrics["clip_fraction"] == 0
        assert "steer" in str(update)
    scored = advantages.VTrace(critic, actor)(batch.clone())["current_log_prob"]
    torch.testing.assert_close(scored, batch["action", "steer_log_prob"] + batch["action", "gear_log_prob"])


@pytest.mark.parametrize("name", ["ClipPPOLoss", "KLPENPPOLoss", "A2CLoss"])
def test_padded_entries_have_no_part_in_losses_nor_metrics(name):
    env = envs.make("Pendulum-v1")
    actor, critic = modules.gaussian_actor(env), modules.state_value(env)
    batch = make_batch(actor, env, rows=6)
    batch["value_target"] = torch.randn(6, 1)
    loss = getattr(losses, name)(actor, critic, normalize_advantage=True)
    loss.keep_distribution(batch)
    batch["action_log_prob"] -= 0.3
    alone = loss(batch[:4].clone()).to_dict()
    loss = getattr(losses, name)(actor, critic, normalize_advantage=True)
    batch["advantage"][4:] = batch["value_target"][4:] = batch["observation"][4:] = 100
    batch["collector", "mask"] = torch.tensor([True] * 4 + [False] * 2)
    assert_close(loss(batch).to_dict(), alone)


@pytest.mark.fault(
    kind=33,
    injected="PPO's loss at log-ratios of ±1,000",
    outcome="value and gradient are finite",
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_surrogate_is_finite_far_from_the_policy_that_acted(dtype):
    # e^1000 is infinite: min(inf * A, 1.2 A) is 1.2 A for A > 0, with the gradient 0 * inf if nothing is done about it
    log_ratio = torch.tensor([1000.0, 1000.0, -1000.0, -1000.0, 0.0], dtype=dtype, requires_grad=True)
    advantage = torch.tensor([2.0, -2.0, 2.0, -2.0, 3.0], dtype=dtype)
    value = functional.clip_surrogate(log_ratio, advantage, 0.2)
    assert value.isfinite().all() and value.tolist()[0] == pytest.approx(2.4)
    assert value.tolist()[2:] == [0.0, pytest.approx(-1.6), 3.0]  # ratio 0: min(0, 1.6) and min(-0, -1.6); ratio 1
    (grad,) = torch.autograd.grad(value.sum(), log_ratio)
    assert grad.tolist() == [0.0, 0.0, 0.0, 0.0, 3.0]
