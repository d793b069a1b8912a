"""TQC's loss: values by hand, agreement with TorchRL's, gradients."""

import pytest
import torch
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate
from torchrl.objectives import TQCLoss as TorchRLTQCLoss

from pgkit import controllers, envs, heads, losses, modules
from pgkit.errors import UserError
from tests.losses.test_redq import assert_each_term_trains_its_own, constant_noise, gradients, shake_targets
from tests.losses.test_sac import batch

__all__ = ["constant_noise"]


def test_agrees_with_torchrl():
    torch.manual_seed(0)
    env = envs.make("HalfCheetah-v5")
    actor = modules.tanh_normal_actor(env, (16,)).double()
    net = lambda: MLP(in_features=23, out_features=9, num_cells=[16])  # noqa: E731
    critics = [ValueOperator(net(), in_keys=["observation", "action"]).double() for _ in range(3)]
    data = batch(obs=17, actions=6).double()
    data["next", "done"], data["next", "terminated"] = (data["next", k].bool() for k in ("done", "terminated"))
    theirs = TorchRLTQCLoss(actor, critics, num_qvalue_nets=3, target_entropy=-6.0, alpha_init=0.3)
    theirs.make_value_estimator(gamma=0.97)
    mine = losses.TQCLoss(actor, critics, alpha_init=0.3, gamma=0.97)
    for loss in (mine, theirs):
        SoftUpdate(loss, tau=0.1)
    shake_targets(mine, theirs)
    outs = []
    for loss in (mine, theirs):
        torch.manual_seed(7)
        outs.append(loss(data.copy()))
    for key in ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy"):
        torch.testing.assert_close(outs[0][key], outs[1][key])
    grads = [gradients(loss, out) for loss, out in zip((mine, theirs), outs, strict=True)]
    for term in grads[0]:
        for x, y in zip(grads[0][term], grads[1][term], strict=True):
            torch.testing.assert_close(x, y)


@pytest.mark.usefixtures("constant_noise")
def test_values_by_hand():
    # two critics of two quantiles, everywhere (0, 4) and (2, 10); one left out for each: the target has 0 and 2
    # y = 1 + 0.5 * (0, 2) = 1, 2, weights 1/2; tau = 1/4, 3/4
    # critic 1: theta 0: differences 1, 2: Huber .5, 1.5, slope 1/4: mean .25; theta 4: -3, -2: 2.5, 1.5, slope 1/4: .5
    #           -> (.25 + .5) / 2 = .375
    # critic 2: theta 2: -1, 0: .5, 0, slope 3/4: .1875; theta 10: -9, -8: 8.5, 7.5, slope 1/4: 2 -> 1.09375
    # actor: minus the mean of 0 4 2 10 = -4
    env = envs.make("Pendulum-v1")
    critics = modules.q_value(env, 2, (), head=heads.Quantiles(2, drop=1))
    last = critics.module.layers[-1]
    last.weight.data.zero_()
    last.bias.data[:, 0] = torch.tensor([[0.0, 4.0], [2.0, 10.0]])
    loss = losses.TQCLoss(
        modules.tanh_normal_actor(env, (8,)), critics, temperature=controllers.FixedTemperature(0.0), gamma=0.5
    )
    SoftUpdate(loss, tau=0.1)
    data = batch(4)
    data["next", "reward"].fill_(1.0)
    data["next", "terminated"].fill_(False)
    out = loss(data)
    assert out["loss_qvalue"].item() == pytest.approx(0.375 + 1.09375)
    assert out["loss_actor"].item() == -4.0
    assert data["td_error"].tolist() == [4.5] * 4  # means 2 and 6, target's 1.5
    settings = {"temperature": controllers.FixedTemperature(0.0), "gamma": 0.5, "actor_value": "mean"}
    same = losses.SACLoss(loss.actor_network, critics, **settings)
    SoftUpdate(same, tau=0.1)
    assert same(data)["loss_qvalue"] == out["loss_qvalue"] and same(data)["loss_actor"] == out["loss_actor"]


def test_gradients_reach_the_right_parameters():
    env = envs.make("Pendulum-v1")
    critics = modules.q_value(env, 3, (8,), head=heads.Quantiles(5))
    loss = losses.TQCLoss(modules.tanh_normal_actor(env, (8,)), critics)
    SoftUpdate(loss, tau=0.1)
    assert_each_term_trains_its_own(loss, loss(batch()))


def test_a_pool_that_would_be_empty_is_refused():
    env = envs.make("Pendulum-v1")
    critics = modules.q_value(env, 2, (8,), head=heads.Quantiles(10))
    loss = losses.TQCLoss(modules.tanh_normal_actor(env, (8,)), critics, head=heads.Quantiles(25, drop=10))
    SoftUpdate(loss, tau=0.1)
    with pytest.raises(UserError, match="drop=10 of 10 quantiles of each critic: it must leave at least one"):
        loss(batch())
