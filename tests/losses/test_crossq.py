"""CrossQ's loss: the joint forward, agreement with TorchRL's, gradients, no target network."""

from functools import partial

import pytest
import torch
from torchrl.modules import MLP, BatchRenorm1d, ValueOperator
from torchrl.objectives import CrossQLoss as TorchRLCrossQLoss

from pgkit import controllers, envs, losses, modules, updates
from tests.losses.test_redq import assert_each_term_trains_its_own, constant_noise, gradients
from tests.losses.test_sac import batch

__all__ = ["constant_noise"]


def test_agrees_with_torchrl():
    torch.manual_seed(0)
    env = envs.make("HalfCheetah-v5")
    actor = modules.tanh_normal_actor(env, (16,)).double()
    critics = [modules.q_value(env, 1, (16,)).double() for _ in range(2)]
    data = batch(obs=17, actions=6).double()
    data["next", "done"], data["next", "terminated"] = (data["next", k].bool() for k in ("done", "terminated"))
    theirs = TorchRLCrossQLoss(actor, critics, loss_function="l2", target_entropy=-6.0, alpha_init=0.3)
    theirs.make_value_estimator(gamma=0.97)
    mine = losses.CrossQLoss(actor, critics, alpha_init=0.3, gamma=0.97)
    outs = []
    for loss in (mine, theirs):
        copy = data.copy()
        torch.manual_seed(7)
        out = loss(copy)
        outs.append((out, copy["td_error"], gradients(loss, out)))
    (a, error, grads), (b, their_error, their_grads) = outs
    for key in ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy"):
        torch.testing.assert_close(a[key], b[key])
    torch.testing.assert_close(error, their_error)
    for term in grads:
        for x, y in zip(grads[term], their_grads[term], strict=True):
            torch.testing.assert_close(x, y)


@pytest.mark.usefixtures("constant_noise")
def test_values_by_hand_of_a_joint_batch_norm():
    # Q_i = batch norm of the observation: s = 0, 2 and s' = 4, 10 are normalized together: mean 4, variance
    # (16 + 4 + 0 + 36) / 4 = 14. Apart they would be -1, 1 and -1, 1. y = 1 + 0.5 * (s' - 4) / √14
    # the running statistics move once, by the share 0.01 from 0 and 1: mean 0.04, variance 1 + 0.01 * (14 - 1) = 1.13
    # and the actor's loss reads those: -mean((s - 0.04) / √1.13) over s = 0, 2
    env = envs.make("Pendulum-v1")
    body = partial(modules.batch_renorm_mlp, hidden=(), norm=partial(modules.EnsembleBatchRenorm, eps=0.0))
    critics = modules.q_value(env, 2, body=body).double()
    norm, last = critics.module.layers
    last.weight.data.zero_()
    last.weight.data[:, 0, 0] = 1.0
    actor = modules.tanh_normal_actor(env, (8,)).double()
    loss = losses.CrossQLoss(actor, critics, temperature=controllers.FixedTemperature(0.0), gamma=0.5)
    data = batch(2).double()
    for key in ("done", "terminated"):
        data["next", key] = torch.zeros(2, 1, dtype=torch.bool)
    data["observation"][:, 0] = torch.tensor([0.0, 2.0])
    data["next", "observation"][:, 0] = torch.tensor([4.0, 10.0])
    data["next", "reward"].fill_(1.0)
    for other in (1, 2):  # not constant, so that no variance is zero
        data["observation"][:, other] = torch.tensor([1.0, 2.0])
    out = loss(data)
    q, target = [(0 - 4) / 14**0.5, (2 - 4) / 14**0.5], [1.0, 1 + 0.5 * 6 / 14**0.5]
    squares = [(a - b) ** 2 for a, b in zip(q, target, strict=True)]
    assert out["loss_qvalue"].item() == pytest.approx(2 * sum(squares) / 2)
    assert out["loss_actor"].item() == pytest.approx(-(1 - 0.04) / 1.13**0.5)
    assert norm.mean[:, 0, 0].tolist() == [pytest.approx(0.04)] * 2
    assert norm.var[:, 0, 0].tolist() == [pytest.approx(1.13)] * 2
    assert norm.steps.flatten().tolist() == [1, 1]


@pytest.mark.usefixtures("constant_noise")
def test_a_delayed_target_by_its_running_statistics():
    # as above, but y = 1 + 0.5 * (s' - m) / σ with the target's running statistics, m = 1 and σ = 2
    env = envs.make("Pendulum-v1")
    body = partial(modules.batch_renorm_mlp, hidden=(), norm=partial(modules.EnsembleBatchRenorm, eps=0.0))
    critics = modules.q_value(env, 2, body=body).double()
    norm, last = critics.module.layers
    last.weight.data.zero_()
    last.weight.data[:, 0, 0] = 1.0
    norm.mean.fill_(1.0)
    norm.var.fill_(4.0)
    actor, fixed = modules.tanh_normal_actor(env, (8,)).double(), controllers.FixedTemperature(0.0)
    loss = losses.CrossQLoss(actor, critics, temperature=fixed, gamma=0.5, delay_qvalue=True)
    assert updates.targets.averaging(loss, 0.005) is not None
    data = batch(2).double()
    for key in ("done", "terminated"):
        data["next", key] = torch.zeros(2, 1, dtype=torch.bool)
    data["observation"] = torch.tensor([[0.0, 1.0, 1.0], [2.0, 2.0, 2.0]]).double()
    data["next", "observation"][:, 0] = torch.tensor([4.0, 10.0])
    data["next", "reward"].fill_(1.0)
    q, target = [(0 - 4) / 14**0.5, (2 - 4) / 14**0.5], [1 + 0.5 * 3 / 2, 1 + 0.5 * 9 / 2]
    squares = [(a - b) ** 2 for a, b in zip(q, target, strict=True)]
    assert loss(data)["loss_qvalue"].item() == pytest.approx(2 * sum(squares) / 2)


def test_there_is_no_target_network():
    env = envs.make("Pendulum-v1")
    loss = losses.CrossQLoss(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 2, (8,)))
    assert not [name for name, _ in loss.named_children() if name.startswith("target_")]
    assert updates.targets.averaging(loss, 0.005) is None


def test_gradients_reach_the_right_parameters():
    env = envs.make("Pendulum-v1")
    actor = modules.tanh_normal_actor(env, encoder=modules.Encoder(env, partial(modules.batch_renorm_mlp, hidden=(8,))))
    loss = losses.CrossQLoss(actor, modules.q_value(env, 2, body=partial(modules.batch_renorm_mlp, hidden=(8,))))
    assert_each_term_trains_its_own(loss, loss(batch()))


def test_batch_statistics_are_used_in_a_list_of_critics_as_in_an_ensemble():
    env = envs.make("Pendulum-v1")
    body = partial(modules.batch_renorm_mlp, hidden=(8,))
    actor = modules.tanh_normal_actor(env, (8,))
    critics = modules.q_value(env, 2, body=body)
    several = losses.CrossQLoss(actor, [modules.q_value(env, 1, body=body) for _ in range(2)])
    together = losses.CrossQLoss(actor, critics)
    for key, x in several.qvalue_network_params.items(True, True):
        together.qvalue_network_params[key].data.copy_(x.data.squeeze(1))  # [2, 1, ...]
    data, results = batch(), []
    for loss in (several, together):
        torch.manual_seed(0)
        results.append(loss(data)["loss_qvalue"])
    torch.testing.assert_close(*results)
    for loss in (several, together):
        assert all((x == 1).all() for key, x in loss.qvalue_network_params.items(True, True) if key[-1] == "steps")


@pytest.mark.parametrize("norm", [torch.nn.BatchNorm1d, partial(BatchRenorm1d, warmup_steps=0)])
def test_critics_whose_normalization_goes_by_a_mode_are_normalized_as_in_torchrl(norm):
    env, data, results = envs.make("Pendulum-v1"), batch(), []
    for name in ("mine", "theirs"):
        torch.manual_seed(0)
        actor = modules.tanh_normal_actor(env, (8,))
        nets = [MLP(4, 1, num_cells=[8], norm_class=norm, norm_kwargs={"num_features": 8}) for _ in range(2)]
        critics = [ValueOperator(net, in_keys=["observation", "action"]) for net in nets]
        if name == "mine":
            loss = losses.CrossQLoss(actor, critics)
        else:
            loss = TorchRLCrossQLoss(actor, critics, loss_function="l2", action_spec=env.action_spec_unbatched)
            loss.make_value_estimator(gamma=0.99)
        for _ in range(2):  # from the second on, the running statistics are not the first ones
            torch.manual_seed(1)
            out = loss(data.clone())
        statistics = {key: x for key, x in loss.qvalue_network_params.items(True, True) if "running" in str(key)}
        results.append(({key: out[key] for key in ("loss_actor", "loss_qvalue")}, statistics))
        assert loss.qvalue_network.training and statistics
    torch.testing.assert_close(*results)
