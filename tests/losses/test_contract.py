"""What every loss keeps, whatever its algorithm: the entries it reads and writes, its metrics, its settings."""

import inspect

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from pgkit import envs, heads, losses, modules
from pgkit.errors import UserError

BASES = {"Loss", "PolicyLoss", "QLoss", "ActorCriticLoss", "SoftQLoss", "Sum"}
ELSEWHERE = {"GRPOLoss", "SFTLoss", "ReconstructionLoss"}  # no actor of an environment: tests of their own
ALGORITHMS = sorted(set(losses.__all__) - BASES - ELSEWHERE)
CRITICS = 4


def make(name, **settings):
    """The loss over small networks, the same ones at every call, with targets of their own."""
    torch.manual_seed(0)
    env = envs.make("CartPole-v1" if name == "DiscreteSACLoss" else "Pendulum-v1")
    kind = getattr(losses, name)
    if issubclass(kind, losses.PolicyLoss):
        actor, critic = modules.gaussian_actor(env, (8,)), modules.state_value(env, (8,))
        return kind(actor, critic, **settings)
    if name in ("DDPGLoss", "TD3Loss"):
        actor, critics = modules.deterministic_actor(env, (8,)), modules.q_value(env, 1 if name == "DDPGLoss" else 2)
        settings |= {"action_spec": env.action_spec_unbatched} if name == "TD3Loss" else {}
    elif name == "DiscreteSACLoss":
        actor, critics = modules.categorical_actor(env, (8,)), modules.discrete_q_value(env, CRITICS, (8,))
    else:
        head = heads.Quantiles(5, drop=1) if name == "TQCLoss" else None
        actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, CRITICS, (8,), head=head)
    loss = kind(actor, critics, **settings)
    if any(name.startswith("target_") for name, _ in loss.named_buffers()):
        SoftUpdate(loss, tau=0.1)
    torch.manual_seed(1)
    for target in [x for name, x in loss.named_buffers() if name.startswith("target_")]:
        target.add_(0.1 * torch.randn_like(target))
    return loss


def batch(name, size=16):
    torch.manual_seed(2)
    obs = 4 if name == "DiscreteSACLoss" else 3
    rows = {
        "observation": torch.randn(size, obs),
        "action": torch.randint(2, (size,)) if name == "DiscreteSACLoss" else torch.rand(size, 1) * 2 - 1,
        "next": {
            "observation": torch.randn(size, obs),
            "reward": torch.randn(size, 1),
            "done": torch.rand(size, 1) < 0.5,
            "terminated": torch.rand(size, 1) < 0.3,
        },
    }
    if issubclass(getattr(losses, name), losses.PolicyLoss):
        rows |= {key: torch.randn(size, 1) for key in ("advantage", "value_target", "state_value")}
        rows |= {"action_log_prob": torch.randn(size), "loc": torch.randn(size, 1), "scale": torch.rand(size, 1) + 0.5}
    return TensorDict(rows, [size])


def result(loss, data):
    torch.manual_seed(3)
    return loss(data)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_entries_and_metrics(name):
    loss, data = make(name), batch(name)
    kept = ["loc", "scale"] if name in ("KLPENPPOLoss", "TRPOLoss") else []
    before = data.select(*loss.in_keys, *kept)
    out = result(loss, after := before.clone())
    assert set(out.keys()) == set(loss.out_keys)
    terms = [key for key in out.keys() if key.startswith("loss_")]
    assert terms and all(out[key].shape == () and out[key].requires_grad for key in terms)
    assert all(out[key].shape == () and not out[key].requires_grad for key in set(out.keys()) - set(terms))
    assert set(after.keys(True, True)) - set(before.keys(True, True)) <= {"td_error"}
    for key in before.keys(True, True):
        torch.testing.assert_close(after[key], before[key], rtol=0, atol=0)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_sum_and_mean_and_none_are_the_same_loss(name):
    mean, total, each = (result(make(name, reduction=how), batch(name)) for how in ("mean", "sum", "none"))
    for key in [key for key in mean.keys() if key.startswith("loss_")]:
        torch.testing.assert_close(each[key].sum(), total[key])
        torch.testing.assert_close(each[key].mean(), mean[key])
        assert each[key].shape in ((16,), ())


@pytest.mark.parametrize("name", ALGORITHMS)
def test_rows_that_a_mask_leaves_out_count_nowhere(name):
    found = []
    for spoilt in (1.0, 50.0):
        data = batch(name)
        for x in (data["observation"], data["next", "observation"], data["next", "reward"], *map(data.get, PER_ROW)):
            if x is not None:
                x[10:] *= spoilt
        data["collector", "mask"] = torch.arange(16) < 10
        out = result(make(name), data)
        found.append(
            {key: x for key, x in out.items() if not key.endswith("_max")} | {"td_error": data.get("td_error", 0)}
        )
    torch.testing.assert_close(*found)


PER_ROW = ("advantage", "value_target", "state_value", "action_log_prob")
OTHER = {
    "actor_value": ("min", "mean"), "alpha_init": (1.0, 0.5), "clip_epsilon": (0.2, 0.1), "critic_coeff": (1.0, 0.5),
    "entropy_coeff": (0.0, 0.1), "form": ("expectation", "gumbel_softmax"), "gamma": (0.99, 0.9),
    "loss_critic_type": ("l2", "l1"), "loss_function": ("l2", "l1"), "max_alpha": (None, 0.5), "min_alpha": (None, 2.0),
    "delay_actor": (False, True), "delay_qvalue": (False, True), "delay_value": (False, True),
    "normalize_advantage": (False, True), "policy_noise": (0.2, 0.4), "noise_clip": (0.5, 0.05),
    "sub_sample_len": (2, 3), "subset": (None, 2), "target_entropy": (-1.0, -3.0), "clip_value": (None, 0.01),
}  # fmt: skip
FIXED = {
    "CrossQLoss": {"delay_actor", "delay_qvalue"},
    "TQCLoss": {"loss_function"},
    "DDPGLoss": {"delay_qvalue"},
    "ReinforceLoss": {"entropy_coeff", "critic_coeff", "normalize_advantage"},
}


def takes(name):
    bases = [
        base
        for base in getattr(losses, name).__mro__
        if base.__module__.startswith("pgkit.") and "__init__" in vars(base)
    ]
    known = {setting for base in bases for setting in inspect.signature(base.__init__).parameters}
    return sorted(known & set(OTHER) - FIXED.get(name, set()))


@pytest.mark.parametrize(("name", "setting"), [(name, setting) for name in ALGORITHMS for setting in takes(name)])
def test_no_setting_is_ignored(name, setting):
    results = []
    for value in OTHER[setting]:
        loss = make(name, **{setting: value})
        out = result(loss, batch(name))
        terms = torch.stack([out[key] for key in out.keys() if key.startswith("loss_")])
        params = dict.fromkeys(p for p in loss.parameters() if p.requires_grad)
        gradients = torch.autograd.grad(terms.sum(), list(params), allow_unused=True, materialize_grads=True)
        results.append([terms.detach(), *gradients])
    assert any(not torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_what_a_loss_has_no_use_for_is_refused():
    with pytest.raises(UserError, match="expected values: it has no use for head=Quantiles"):
        make("DiscreteSACLoss", head=heads.Quantiles(5))
    with pytest.raises(UserError, match="loss_function='l1' is for critics without a head"):
        make("TQCLoss", loss_function="l1")
    for name in ALGORITHMS:
        with pytest.raises(TypeError, match="unexpected keyword argument 'entropi_coeff'"):
            make(name, entropi_coeff=0.1)


def test_coefficients_are_exact_and_what_a_step_writes_is_float32():
    """A compiled graph loses writes to a float64 scalar."""
    written = {"beta", "log_alpha", "temperature.log_alpha"}
    for name in ALGORITHMS:
        loss = make(name)
        scalars = {key: x for key, x in [*loss.named_buffers(), *loss.named_parameters()] if x.dim() == 0}
        assert scalars or name == "ReinforceLoss"
        for key, x in scalars.items():
            assert x.dtype == (torch.float32 if key in written else torch.float64), (name, key)
    assert (
        make("SACLoss", gamma=0.97).gamma.item() == 0.97
        and make("ClipPPOLoss", clip_epsilon=0.1).clip_epsilon.item() == 0.1
    )


@pytest.mark.parametrize("name", ALGORITHMS)
def test_networks_that_do_not_fit_are_named(name):
    kind, env = getattr(losses, name), envs.make("Pendulum-v1")
    settings = {"action_spec": env.action_spec_unbatched} if name == "TD3Loss" else {}
    deterministic = name in ("TD3Loss", "DDPGLoss")
    actor = make(name).actor_network
    with pytest.raises(UserError, match=f"{name} takes TensorDict modules, its .*_network is a Linear: wrap it"):
        kind(actor, torch.nn.Linear(3, 1), **settings)
    other = (modules.gaussian_actor if deterministic else modules.deterministic_actor)(env)
    message = "needs an actor that gives one action" if deterministic else "needs an actor that draws"
    with pytest.raises(UserError, match=f"{name} {message}"):
        kind(other, modules.q_value(env, 1), **settings)
