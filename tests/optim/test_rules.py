"""The rules against torch's optimizers, numbers worked out by hand, and steps on a gradient that is not finite."""

from functools import partial

import pytest
import torch

from pgkit import optim
from pgkit.errors import UserError
from pgkit.optim.rules import adam

OPTIMIZERS = [
    torch.optim.Adam,
    partial(torch.optim.Adam, weight_decay=0.1, maximize=True, betas=(0.5, 0.9), eps=1e-3),
    partial(torch.optim.AdamW, weight_decay=0.1),
    partial(torch.optim.AdamW, amsgrad=True),
    torch.optim.SGD,
    partial(torch.optim.SGD, momentum=0.9, nesterov=True, weight_decay=0.1),
    partial(torch.optim.SGD, momentum=0.5, maximize=True),
    torch.optim.RMSprop,
    partial(torch.optim.RMSprop, momentum=0.9, centered=True, weight_decay=0.1, maximize=True),
]


def numbers(dtype=torch.float64):
    return [torch.linspace(-1, 1, n, dtype=dtype).requires_grad_() for n in (3, 5)]


def gradients(step):
    return [(i + 2 - step) * torch.ones(n).double().cumsum(0) for i, n in enumerate((3, 5))]


def bound(optimizer, params=None) -> optim.Bound:
    rules = optim.bound(optimizer, params)
    assert rules is not None
    return rules


def assert_same_state(optimizer, twin):
    mine, theirs = optimizer.state_dict()["state"], twin.state_dict()["state"]
    for i, state in theirs.items():
        for name, value in state.items():
            if value is not None:
                torch.testing.assert_close(mine[i][name], value, rtol=1e-12, atol=1e-12, check_dtype=False)


@pytest.mark.parametrize("make", OPTIMIZERS)
def test_a_rule_does_what_torch_does(make):
    params, twins = numbers(), numbers()
    optimizer, twin = make(params, lr=0.1), make(twins, lr=0.1)
    whole, part = bound(optimizer), bound(optimizer, params[:1])
    for step in range(6):
        both = step % 2 == 0  # the counters of the parameters differ
        grads = gradients(step)
        for p, grad in zip(twins, grads, strict=True):
            p.grad = grad if both or p is twins[0] else None
        twin.step()
        (whole if both else part).apply(grads if both else grads[:1])
    torch.testing.assert_close(params, twins, rtol=1e-12, atol=1e-12)
    assert_same_state(optimizer, twin)


@pytest.mark.parametrize("make", OPTIMIZERS)
def test_a_rule_goes_on_where_torch_s_optimizer_stopped_and_back(make):
    params, twins = numbers(), numbers()
    optimizer, twin = make(params, lr=0.1), make(twins, lr=0.1)
    for step in range(9):
        grads = gradients(step)
        optim.step(twin, twins, grads)
        bound(optimizer).apply(grads) if step // 3 == 1 else optim.step(optimizer, params, grads)
    torch.testing.assert_close(params, twins, rtol=1e-12, atol=1e-12)
    assert_same_state(optimizer, twin)


def test_adam_by_hand():
    # lr 0.1, betas (0.5, 0.75), eps 0, gradients 2 and 4:
    # step 1: m = 1, v = 1; corrected 1/0.5 = 2 and 1/0.25 = 4: 1 - 0.1 * 2 / 2 = 0.9
    # step 2: m = 0.5 + 2 = 2.5, v = 0.75 + 4 = 4.75; corrected 2.5/0.75 and 4.75/0.4375:
    # 0.9 - 0.1 * (10/3) / sqrt(76/7) = 0.9 - 0.10116282978 = 0.79883717022
    p = torch.ones(1, dtype=torch.float64, requires_grad=True)
    rules = bound(torch.optim.Adam([p], lr=0.1, betas=(0.5, 0.75), eps=0.0))
    rules.apply([torch.full((1,), 2.0, dtype=torch.float64)])
    assert p.item() == pytest.approx(0.9, abs=1e-12)
    rules.apply([torch.full((1,), 4.0, dtype=torch.float64)])
    assert p.item() == pytest.approx(0.79883717022, abs=1e-10)


def test_a_rule_is_pure():
    rule = adam(betas=(0.9, 0.999), eps=1e-8, weight_decay=0.1, amsgrad=True, maximize=True)
    params = [p.detach() for p in numbers()]
    states = [rule.init(p) for p in params]
    state = {name: [own[name] for own in states] for name in states[0]}
    grads = gradients(0)
    before = [x.clone() for x in (*params, *grads, *(x for xs in state.values() for x in xs))]
    moved, new = rule.update(grads, state, params, torch.tensor(0.1).double())
    assert not torch.equal(moved[0], params[0]) and new.keys() == state.keys()
    after = [*params, *grads, *(x for xs in state.values() for x in xs)]
    assert all(torch.equal(*pair) for pair in zip(before, after, strict=True))


@pytest.mark.parametrize("make", OPTIMIZERS)
@pytest.mark.parametrize("worst", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_changes_nothing(make, worst):
    params, twins = numbers(), numbers()
    rules, twin = bound(make(params, lr=0.1)), bound(make(twins, lr=0.1))
    for step in range(4):
        grads = gradients(step)
        twin.apply(grads)
        rules.apply(grads, torch.tensor(True))
        grads[1][2] = worst
        before = [x.detach().clone() for x in (*params, *rules.tensors)]
        norm = torch.stack([grad.square().sum() for grad in grads]).sum().sqrt()
        rules.apply(grads, norm.isfinite())
        assert all(torch.equal(*pair) for pair in zip(before, (*params, *rules.tensors), strict=True))
    assert torch.equal(params[0], twins[0]) and torch.equal(params[1], twins[1])


def test_learning_rates_are_read_from_the_groups():
    params = numbers()
    optimizer = torch.optim.SGD([{"params": params[:1], "lr": 1.0}, {"params": params[1:]}], lr=0.5)
    before, rules = [p.detach().clone() for p in params], bound(optimizer)
    optimizer.param_groups[1]["lr"] = torch.tensor(0.25)
    rules.read()
    rules.apply([torch.ones_like(p) for p in params])
    torch.testing.assert_close(params[0], before[0] - 1.0)
    torch.testing.assert_close(params[1], before[1] - 0.25)


@pytest.mark.parametrize("change", ["cleared", "loaded"])
def test_a_state_that_is_reset_or_loaded_goes_on_in_the_tensors_of_the_graph(change):
    params, others = numbers(), numbers()
    optimizer, other = torch.optim.Adam(params, lr=0.1), torch.optim.Adam(others, lr=0.2)
    rules, tensors = bound(optimizer), bound(optimizer).tensors
    rules.apply(gradients(0))
    if change == "cleared":
        optimizer.state.clear()
    else:
        for step in range(3):
            optim.step(other, others, gradients(step))
        optimizer.load_state_dict(other.state_dict())
    rules.read()
    with torch.no_grad():
        for p, value in zip(params, others, strict=True):
            p.copy_(value)
    rules.apply(gradients(5))
    optim.step(other if change == "loaded" else (other := torch.optim.Adam(others, lr=0.1)), others, gradients(5))
    torch.testing.assert_close(params, others, rtol=1e-12, atol=1e-12)
    assert_same_state(optimizer, other)
    own = [x for state in optimizer.state.values() for x in state.values()]
    assert len(own) == 6 and all(any(x is tensor for tensor in tensors) for x in own)


def test_settings_that_a_graph_holds_may_not_change():
    optimizer = torch.optim.Adam(numbers(), lr=0.1)
    rules = bound(optimizer)
    optimizer.param_groups[0].update(lr=0.2, fused=True)
    rules.read()
    optimizer.param_groups[0]["betas"] = (0.5, 0.9)
    with pytest.raises(
        UserError, match=r"betas changed from \(0.9, 0.999\) to \(0.5, 0.9\): while training only lr may"
    ):
        rules.read()


def test_what_has_no_rule_steps_outside():
    params = numbers()
    for optimizer in (
        torch.optim.Adagrad(params),
        torch.optim.SGD(params, lr=0.1, momentum=0.9, dampening=0.5),
        torch.optim.Adam(params, capturable=True),
        optim.Together(torch.optim.Adam(params[:1]), torch.optim.Adagrad(params[1:])),
        type("Mine", (torch.optim.Adam,), {})(params),  # it may step in its own way
    ):
        assert optim.bound(optimizer) is None


def test_several_optimizers_are_bound_together():
    params, twins = numbers(), numbers()
    optimizer, twin = (
        optim.Together(torch.optim.Adam(ps[1:], lr=0.1), torch.optim.SGD(ps[:1], lr=0.5)) for ps in (params, twins)
    )
    rules = bound(optimizer)
    assert [p is q for p, q in zip(rules.params, optim.parameters(optimizer), strict=True)] == [True, True]
    for step in range(3):
        grads = gradients(step)[::-1]
        rules.apply(grads)
        optim.step(twin, optim.parameters(twin), grads)
    torch.testing.assert_close(params, twins, rtol=1e-12, atol=1e-12)


def test_the_step_outside_leaves_the_user_s_settings_and_other_parameters_alone(monkeypatch):
    params = numbers(torch.float32)
    optimizer = torch.optim.Adam(params, lr=0.1)
    settings, before, taken = dict(optimizer.param_groups[0]), params[1].detach().clone(), []
    params[1].grad = torch.ones(5)  # of another loss
    step = optimizer.step
    monkeypatch.setattr(optimizer, "step", lambda: (taken.append(optimizer.param_groups[0]["fused"]), step()))
    optim.step(optimizer, params[:1], [torch.ones(3)])
    optimizer.param_groups[0]["foreach"] = True
    optim.step(optimizer, params[:1], [torch.ones(3)])
    assert taken == [True, None]  # fused where nothing was chosen
    assert {**settings, "foreach": True} == optimizer.param_groups[0] and torch.equal(params[1], before)


@pytest.mark.parametrize("together", [False, True])
def test_a_counter_that_a_checkpoint_brought_to_the_cpu_goes_where_the_parameter_is(together):
    """The fused kernel of a GPU reads it there; a GPU stands here as the meta device."""
    p = torch.zeros(3, device="meta", requires_grad=True)
    adam = torch.optim.Adam([p])
    moments = {name: torch.zeros_like(p, requires_grad=False) for name in ("exp_avg", "exp_avg_sq")}
    adam.state[p] = {"step": torch.tensor(7.0), **moments}
    optim.step(optim.Together(adam) if together else adam, [p], [torch.ones_like(p)])
    assert adam.state[p]["step"].device == p.device
