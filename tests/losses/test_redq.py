"""REDQ's loss: values by hand, agreement with TorchRL's, gradients, the subset."""

import pytest
import torch
from torchrl.objectives import REDQLoss as TorchRLREDQLoss
from torchrl.objectives import SoftUpdate

from pgkit import controllers, envs, heads, losses, modules
from pgkit.errors import UserError
from tests.losses.test_sac import batch


@pytest.fixture
def constant_noise(monkeypatch):
    """Every draw of the policy's noise is 0.3, in whatever order the draws come."""
    monkeypatch.setattr(
        "torch.distributions.normal._standard_normal",
        lambda shape, dtype, device: torch.full(shape, 0.3, dtype=dtype, device=device),
    )


def shake_targets(*several):
    """Moves the targets of the first loss off their sources, and those of the others to the same place."""
    first, *others = [list(loss.target_qvalue_network_params.values(True, True)) for loss in several]
    for x in first:
        x.data.add_(0.1 * torch.randn_like(x))
    for other in others:
        for x, y in zip(other, first, strict=True):
            x.data.copy_(y)


def gradients(loss, out, terms=("loss_actor", "loss_qvalue")):
    """Of each term, with respect to the actor and to the critics."""
    networks = (loss.actor_network_params, loss.qvalue_network_params)
    params = [p for net in networks for p in net.values(True, True) if p.requires_grad]
    options = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
    return {term: torch.autograd.grad(out[term], params, **options) for term in terms}


def assert_each_term_trains_its_own(loss, out):
    groups = {
        "loss_actor": [p for p in loss.actor_network_params.values(True, True) if p.requires_grad],
        "loss_qvalue": [p for p in loss.qvalue_network_params.values(True, True) if p.requires_grad],
        "loss_alpha": [loss.log_alpha],
    }
    for term in groups:
        for owner, params in groups.items():
            grads = torch.autograd.grad(out[term], params, allow_unused=True, retain_graph=True)
            assert any(g is not None and g.any() for g in grads) == (term == owner), (term, owner)


def double(*modules_):
    return [module.double() for module in modules_]


@pytest.mark.usefixtures("constant_noise")
def test_agrees_with_torchrl():
    torch.manual_seed(0)
    env = envs.make("HalfCheetah-v5")
    actor, *critics = double(modules.tanh_normal_actor(env, (16,)), *(modules.q_value(env, 1, (16,)) for _ in range(5)))
    data = batch(obs=17, actions=6).double()
    data["next", "done"], data["next", "terminated"] = (data["next", k].bool() for k in ("done", "terminated"))
    theirs = TorchRLREDQLoss(
        actor, critics, num_qvalue_nets=5, sub_sample_len=2, loss_function="l2", target_entropy=-6.0, alpha_init=0.3
    )
    theirs.make_value_estimator(gamma=0.97)
    mine = losses.REDQLoss(actor, critics, sub_sample_len=2, alpha_init=0.3, gamma=0.97)
    for loss in (mine, theirs):
        SoftUpdate(loss, tau=0.1)
    shake_targets(mine, theirs)
    outs = []
    for loss in (mine, theirs):
        copy = data.copy()
        torch.manual_seed(7)  # of the subset
        out = loss(copy)
        outs.append((out, copy["td_error"], gradients(loss, out)))
    (a, error, grads), (b, square, their_grads) = outs
    torch.testing.assert_close(a["loss_actor"], b["loss_actor"])
    torch.testing.assert_close(a["loss_qvalue"], 5 * b["loss_qvalue"])  # theirs is the mean over the critics
    torch.testing.assert_close(error**2, square)
    for term, factor in (("loss_actor", 1), ("loss_qvalue", 5)):
        for x, y in zip(grads[term], their_grads[term], strict=True):
            torch.testing.assert_close(x, factor * y)


@pytest.mark.usefixtures("constant_noise")
def test_it_is_sac_with_settings_and_its_own_file_says_the_same():
    env = envs.make("Pendulum-v1")
    actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 6, (8,))
    losses_ = [
        losses.REDQLoss(actor, critics, sub_sample_len=3),
        losses.SACLoss(actor, critics, subset=3, actor_value="mean"),
        losses.SACLoss(actor, critics),
    ]
    data, outs = batch(), []
    for loss in losses_:
        SoftUpdate(loss, tau=0.1)
    shake_targets(*losses_)
    for loss in losses_:
        torch.manual_seed(3)
        outs.append(loss(data.copy()))
    for key in outs[0].keys():
        torch.testing.assert_close(outs[0][key], outs[1][key])
    assert outs[2]["loss_qvalue"] != outs[0]["loss_qvalue"] and outs[2]["loss_actor"] > outs[0]["loss_actor"]


@pytest.mark.usefixtures("constant_noise")
def test_the_target_is_the_least_of_the_drawn_critics_and_the_actor_s_value_the_mean_of_all():
    env = envs.make("Pendulum-v1")
    actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 4, ())
    last = critics.module.layers[-1]
    last.weight.data.zero_()
    last.bias.data[:, 0, 0] = torch.tensor([1.0, 2.0, 3.0, 4.0])  # Q_i = i everywhere
    loss = losses.REDQLoss(actor, critics, sub_sample_len=2, temperature=controllers.FixedTemperature(0.0), gamma=0.5)
    SoftUpdate(loss, tau=0.1)
    data = batch(1)
    data["next", "reward"].fill_(1.0)
    data["next", "terminated"].fill_(False)
    seen = set()
    for _ in range(60):
        out = loss(data)
        # the least of the pair is 1, 2 or 3; y = 1 + 0.5 * least = 1.5, 2, 2.5; sum of (i - y)² = 7.5 - ... by hand:
        # y 1.5: .25 + .25 + 2.25 + 6.25 = 9; y 2: 1 + 0 + 1 + 4 = 6; y 2.5: 2.25 + .25 + .25 + 2.25 = 5
        seen.add(out["loss_qvalue"].item())
        assert out["loss_actor"].item() == -2.5
    assert seen == {9.0, 6.0, 5.0}


def test_gradients_reach_the_right_parameters():
    env = envs.make("Pendulum-v1")
    loss = losses.REDQLoss(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 5, (8,)))
    SoftUpdate(loss, tau=0.1)
    assert_each_term_trains_its_own(loss, loss(batch()))


def test_an_ensemble_of_one_s_own_without_members_and_a_list_take_a_subset_too():
    env = envs.make("Pendulum-v1")
    actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 5, (8,))
    loss = losses.REDQLoss(actor, critics)
    data, index = batch(), torch.tensor([4, 0])
    some = loss.outputs(data, data["action"], loss.qvalue_network_params, index)
    loss.qvalue_network.members = None
    torch.testing.assert_close(loss.outputs(data, data["action"], loss.qvalue_network_params, index), some)
    several = losses.REDQLoss(actor, [modules.q_value(env, 1, (8,)) for _ in range(5)])
    whole = several.outputs(data, data["action"], several.qvalue_network_params)
    some = several.outputs(data, data["action"], several.qvalue_network_params, index)
    torch.testing.assert_close(some, whole[:, index])


def test_settings_that_do_not_fit_the_critics_are_refused():
    env = envs.make("Pendulum-v1")
    with pytest.raises(UserError, match="subset=3 of 2 critics"):
        losses.SACLoss(modules.tanh_normal_actor(env), modules.q_value(env, 2), subset=3)
    with pytest.raises(UserError, match="actor_value='max': give 'min' or 'mean'"):
        losses.SACLoss(modules.tanh_normal_actor(env), modules.q_value(env, 2), actor_value="max")
    critics = modules.q_value(env, 2, head=heads.Quantiles(5))
    with pytest.raises(UserError, match="loss_function='l1' is for critics without a head"):
        losses.SACLoss(modules.tanh_normal_actor(env), critics, loss_function="l1")


@pytest.mark.parametrize(
    "head", [heads.Quantiles(7), heads.Bins(-5, 5, 21), heads.Categorical(-5, 5, 21)], ids=lambda x: type(x).__name__
)
@pytest.mark.parametrize("make", [losses.SACLoss, losses.REDQLoss, losses.CrossQLoss])
def test_every_loss_takes_every_head(make, head):
    env = envs.make("Pendulum-v1")
    loss = make(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 4, (8,), head=head))
    SoftUpdate(loss, tau=0.1) if make is not losses.CrossQLoss else None
    data = batch()
    assert_each_term_trains_its_own(loss, loss(data))
    assert data["td_error"].shape == data.batch_size


class Gain(torch.nn.Module):
    """A layer whose weight has no dimension of the critics."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.rand(8))

    def forward(self, x):
        return x * self.weight


def test_some_critics_of_layers_that_all_of_them_share():
    env = envs.make("Pendulum-v1")

    def body(num, features):
        return [modules.EnsembleLinear(num, features, 8, gain=1.0), Gain()], 8

    loss = losses.SACLoss(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 8, body=body), subset=2)
    data, index = batch(), torch.tensor([4, 0])
    whole = loss.outputs(data, data["action"], loss.qvalue_network_params)
    torch.testing.assert_close(
        loss.outputs(data, data["action"], loss.qvalue_network_params, index), whole[..., index, :]
    )


def test_dropout_in_a_list_of_critics():
    env = envs.make("Pendulum-v1")
    actor = modules.tanh_normal_actor(env, (8,))
    single = modules.q_value(env, 1, (64,), dropout=0.5)
    loss, data = losses.SACLoss(actor, [single, single]), batch()
    loss.qvalue_network_params.apply(lambda x: x.data.copy_(x.data[:1].expand_as(x)))
    value = loss.q(data, data["action"], loss.qvalue_network_params)
    assert not torch.allclose(value[:, 0], value[:, 1])
    loss.set_vmap_randomness("same")
    value = loss.q(data, data["action"], loss.qvalue_network_params)
    torch.testing.assert_close(value[:, 0], value[:, 1])


def test_values_are_not_taken_for_quantiles():
    env = envs.make("Pendulum-v1")
    loss = losses.TQCLoss(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 5, (8,)))
    SoftUpdate(loss, tau=0.1)
    with pytest.raises(UserError, match="needs 25 outputs of each of the 5 critics, there are 1 of 5: give"):
        loss(batch())
