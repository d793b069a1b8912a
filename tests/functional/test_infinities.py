"""Infinities and NaN stay where they are: in ratios, behind the end of an episode, in empty batches."""

import pytest
import torch

from pgkit import advantages, collectors, data, envs, losses, modules, updates
from pgkit.errors import UserError
from pgkit.functional import (
    approx_kl,
    clip_surrogate,
    discounted_sum,
    dual_clip_surrogate,
    explained_variance,
    generalized_advantage,
    lambda_return,
    quadratic_surrogate,
    ratio_surrogate,
    rollback_surrogate,
    standardize,
    vtrace,
)

SURROGATES = [clip_surrogate, dual_clip_surrogate, ratio_surrogate, quadratic_surrogate, rollback_surrogate]
LOG_RATIOS = [-1e5, -200.0, 39.0, 41.0, 50.0, 88.0, 89.0, 200.0, 1e5]


@pytest.mark.fault(
    kind=33,
    injected="log-ratios from -100,000 to 100,000 in every surrogate and in the KL estimate",
    outcome="value and gradient are finite, and up to a log-ratio of 20 the exact ones",
)
@pytest.mark.parametrize("function", [*SURROGATES, lambda log_ratio, _: approx_kl(log_ratio)])
def test_log_ratios_without_bounds(function):
    for sign in (1.0, -1.0):
        log_ratio = torch.tensor(LOG_RATIOS, requires_grad=True)
        value = function(log_ratio, torch.full((len(LOG_RATIOS),), sign))
        value.sum().backward()
        assert value.isfinite().all() and log_ratio.grad is not None and log_ratio.grad.isfinite().all()


def test_beyond_the_bound_ratios_still_rise():
    log_ratio = torch.tensor([38.0, 41.0, 60.0, 300.0], requires_grad=True)
    for function in (lambda x: ratio_surrogate(x, torch.ones(4)), approx_kl):
        log_ratio.grad = None
        value = function(log_ratio)
        value.sum().backward()
        assert (value.diff() > 0).all() and log_ratio.grad is not None and (log_ratio.grad > 0).all()
    below = torch.linspace(-20, 20, 41, dtype=torch.float64)
    assert torch.equal(ratio_surrogate(below, torch.ones(41, dtype=torch.float64)), below.exp())
    assert torch.equal(approx_kl(below), torch.expm1(below) - below)


def column(*x, dtype=torch.float64):
    return torch.tensor(x, dtype=dtype).unsqueeze(-1)


DONE = column(False, False, True, False, False, dtype=torch.bool)


@pytest.mark.fault(
    kind=33,
    injected="NaN and infinities in rewards, values and ratios of the episode after an end",
    outcome="the episode before keeps its exact advantages, returns and targets",
)
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("after", [3, 4])
def test_what_lies_behind_an_end_stays_there(bad, after):
    clean = {"value": column(1, 2, 3, 4, 5), "next_value": column(2, 3, 9, 5, 6), "reward": column(1, 1, 1, 1, 1)}

    def results(x):
        ends = {"done": DONE, "terminated": DONE & False}
        yield from generalized_advantage(**x, **ends, gamma=0.9, lmbda=0.8)
        yield lambda_return(x["next_value"], x["reward"], **ends, gamma=0.9, lmbda=0.8)
        yield from vtrace(x["reward"] * 0.1, **x, **ends, gamma=0.9, lmbda=0.8)
        yield discounted_sum(x["reward"], 0.9 * (~DONE).double())

    for name in clean:
        spoiled = {**clean, name: clean[name].clone()}
        spoiled[name][after] = bad
        for got, expected in zip(results(spoiled), results(clean), strict=True):
            assert torch.equal(got[:3], expected[:3])


@pytest.mark.fault(
    kind=33,
    injected="the value of a final state that is NaN, at a termination",
    outcome="it is not read",
)
def test_the_value_of_a_terminal_state_is_not_read():
    value, reward = column(1, 2, 3, 4, 5), column(1, 1, 1, 1, 1)
    following = column(2, 3, float("nan"), 5, 6)
    assert generalized_advantage(value, following, reward, DONE, DONE, 0.9, 0.8)[0].isfinite().all()
    assert lambda_return(following, reward, DONE, DONE, 0.9, 0.8).isfinite().all()


@pytest.fixture(scope="module")
def parts():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=2)
    actor, critic = modules.gaussian_actor(env, (4,)), modules.state_value(env, (4,))
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=32, compile="off").rollout()
    return env, actor, critic, rollout


@pytest.mark.fault(
    kind=33,
    injected="an empty rollout, batch or draw: no environment, no step, no row",
    outcome="one line with the batch size; statistics stay as they are",
)
def test_empty_batches(parts):
    env, actor, critic, rollout = parts
    rows = advantages.GAE(critic)(rollout.clone()).reshape(-1)
    squashed, q_values = modules.tanh_normal_actor(env, (4,)), modules.q_value(env, 2, (4,))
    for loss in (
        losses.ClipPPOLoss(actor, critic), losses.A2CLoss(actor, critic), losses.ReinforceLoss(actor, critic),
        losses.TRPOLoss(actor, critic), losses.SACLoss(squashed, q_values),
    ):  # fmt: skip
        with pytest.raises(UserError, match=rf"{type(loss).__name__} got an empty batch \[0\]: give it rows"):
            loss(rows[:0])
    adam = torch.optim.Adam([*actor.parameters(), *critic.parameters()])
    update = updates.OnPolicyUpdate(losses.ClipPPOLoss(actor, critic), advantages.GAE(critic), adam, compile="off")
    for empty in (rollout[:, :0], rollout[:0]):
        with pytest.raises(UserError, match=r"GAE got an empty rollout \[.*\]: give it steps"):
            advantages.GAE(critic)(empty.clone())
        with pytest.raises(UserError, match=r"the rollout \[.*\] is empty: collect at least one step"):
            update(empty.clone())
    buffer = data.ReplayBuffer(env, 100)
    buffer.extend(rollout[:, :0])
    buffer.extend(rollout)
    with pytest.raises(UserError, match="batch_size=0: give a whole number, at least 1"):
        buffer.sample(0)
    scale, normalizer = modules.ReturnScale(), modules.ObsNormalizer(env)
    for statistics, empty in ((normalizer, rollout["observation"][:0]), (scale, torch.zeros(0))):
        before = {key: x.clone() for key, x in statistics.state_dict().items()}
        statistics.update(empty)
        assert all(torch.equal(x, before[key]) for key, x in statistics.state_dict().items())


@pytest.mark.fault(
    kind=33,
    injected="a minibatch whose rows are all masked, a rollout of a single row",
    outcome="losses, gradients and weights stay finite",
)
def test_nothing_but_masked_rows(parts):
    _, actor, critic, rollout = parts
    nothing = torch.zeros(2, 16, dtype=torch.bool)
    assert standardize(rollout["next", "reward"], nothing.unsqueeze(-1)).isfinite().all()
    assert explained_variance(rollout["next", "reward"], rollout["next", "reward"], nothing.unsqueeze(-1)).isfinite()
    adam = torch.optim.Adam([*actor.parameters(), *critic.parameters()])
    loss, advantage = losses.ClipPPOLoss(actor, critic), advantages.GAE(critic, average_gae=True)
    for given in (rollout.clone().set(("collector", "mask"), nothing), rollout[:1, :1].clone()):
        update = updates.OnPolicyUpdate(loss, advantage, adam, epochs=1, compile="off")
        metrics = update(given)
        assert all(torch.tensor(x).isfinite() for x in metrics.values()), metrics
        assert all(p.isfinite().all() for p in (*actor.parameters(), *critic.parameters()))
