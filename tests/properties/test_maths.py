"""Properties of the maths: float64 loops over time, order, padding, scale."""

from typing import Any

import torch
from hypothesis import given
from hypothesis import strategies as st

from pgkit import modules
from pgkit.functional import (
    approx_kl,
    categorical_projection,
    clip_surrogate,
    clipped_value_loss,
    explained_variance,
    generalized_advantage,
    group_relative,
    lambda_return,
    n_step_return,
    standardize,
    two_hot,
    value_loss,
    vtrace,
)

SHARES = st.floats(0, 1)


@st.composite
def rollouts(draw: Any) -> dict[str, torch.Tensor]:
    """Values, rewards and ends ``[N, T, 1]`` in float64."""
    envs, steps, seed = draw(st.integers(1, 3)), draw(st.integers(1, 40)), draw(st.integers(0, 2**31))
    generator = torch.Generator().manual_seed(seed)
    value, following, reward = torch.randn(3, envs, steps, 1, generator=generator, dtype=torch.float64)
    done = torch.rand(envs, steps, 1, generator=generator) < draw(st.sampled_from([0.0, 0.1, 0.5, 1.0]))
    terminated = done & (torch.rand(envs, steps, 1, generator=generator) < 0.5)
    return {"value": value, "next_value": following, "reward": reward, "done": done, "terminated": terminated}


def changed(data: dict[str, torch.Tensor], function: Any) -> dict[str, torch.Tensor]:
    return {key: function(x) for key, x in data.items()}


def on_policy_vtrace(**data: Any) -> tuple[torch.Tensor, torch.Tensor]:
    return vtrace(torch.zeros_like(data["value"]), **data)


def loop(data: dict[str, torch.Tensor], gamma: float, lmbda: float) -> torch.Tensor:
    """GAE as the paper writes it, step by step."""
    value, following, reward, done, terminated = data.values()
    advantage, after = torch.zeros_like(value), torch.zeros_like(value[:, 0])
    for t in reversed(range(value.shape[1])):
        delta = reward[:, t] + gamma * following[:, t] * (~terminated[:, t]).double() - value[:, t]
        after = delta + gamma * lmbda * (~done[:, t]).double() * after
        advantage[:, t] = after
    return advantage


@given(rollouts(), SHARES, SHARES)
def test_gae_is_a_loop_over_time(data: Any, gamma: float, lmbda: float):
    advantage, target = generalized_advantage(**data, gamma=gamma, lmbda=lmbda)
    expected = loop(data, gamma, lmbda)
    torch.testing.assert_close(advantage, expected, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(target, expected + data["value"], rtol=1e-9, atol=1e-9)
    single = changed(data, lambda x: x.float() if x.is_floating_point() else x)
    torch.testing.assert_close(
        generalized_advantage(**single, gamma=gamma, lmbda=lmbda)[0].double(), expected, rtol=1e-4, atol=1e-4
    )


@given(rollouts(), SHARES, SHARES, st.floats(1e-3, 1e3))
def test_gae_has_a_unit_and_no_order_of_environments(data: Any, gamma: float, lmbda: float, unit: float):
    plain = generalized_advantage(**data, gamma=gamma, lmbda=lmbda)[0]
    scaled = changed(data, lambda x: x * unit if x.is_floating_point() else x)
    torch.testing.assert_close(generalized_advantage(**scaled, gamma=gamma, lmbda=lmbda)[0], plain * unit)
    turned = changed(data, lambda x: x.flip(0))
    assert torch.equal(generalized_advantage(**turned, gamma=gamma, lmbda=lmbda)[0], plain.flip(0))


@given(rollouts(), rollouts(), SHARES, SHARES)
def test_what_follows_an_end_changes_nothing_before_it(data: Any, more: Any, gamma: float, lmbda: float):
    data, more = changed(data, lambda x: x[:1].clone()), changed(more, lambda x: x[:1])
    data["done"][:, -1] = True
    both = {key: torch.cat([x, more[key]], 1) for key, x in data.items()}
    steps = data["value"].shape[1]
    for function in (generalized_advantage, on_policy_vtrace):
        alone, joined = (function(**x, gamma=gamma, lmbda=lmbda) for x in (data, both))
        for one, other in zip(alone, joined, strict=True):
            torch.testing.assert_close(other[:, :steps], one, rtol=1e-12, atol=1e-12)


@given(rollouts(), SHARES, SHARES)
def test_returns_agree_with_each_other(data: Any, gamma: float, lmbda: float):
    ends = {key: x for key, x in data.items() if key != "value"}
    target = generalized_advantage(**data, gamma=gamma, lmbda=lmbda)[1]
    # where V(s_{t+1}) is V(s'_t) within an episode, the target of GAE is the lambda-return
    linked = {**data, "next_value": data["next_value"].clone()}
    inside = ~data["done"][:, :-1]
    linked["next_value"][:, :-1] = torch.where(inside, data["value"][:, 1:], data["next_value"][:, :-1])
    target = generalized_advantage(**linked, gamma=gamma, lmbda=lmbda)[1]
    ends["next_value"] = linked["next_value"]
    torch.testing.assert_close(lambda_return(**ends, gamma=gamma, lmbda=lmbda), target, rtol=1e-8, atol=1e-8)
    one_step = data["reward"] + gamma * ends["next_value"] * (~data["terminated"]).double()
    torch.testing.assert_close(lambda_return(**ends, gamma=gamma, lmbda=0.0), one_step)
    torch.testing.assert_close(n_step_return(**ends, gamma=gamma, steps=1), one_step)
    on_policy = on_policy_vtrace(**linked, gamma=gamma, lmbda=lmbda)[1]
    torch.testing.assert_close(on_policy, target, rtol=1e-8, atol=1e-8)


numbers = st.lists(st.floats(-50, 50), min_size=2, max_size=30).map(lambda x: torch.tensor(x, dtype=torch.float64))


@given(numbers, st.floats(0.1, 100), st.floats(-100, 100), st.integers(0, 2**31))
def test_standardized_numbers_know_no_unit_no_order_and_no_padding(x: Any, unit: float, shift: float, seed: int):
    x = x + torch.linspace(0, 1, len(x), dtype=torch.float64)  # not all equal
    plain = standardize(x)
    assert abs(float(plain.mean())) < 1e-9
    torch.testing.assert_close(plain.std(), torch.tensor(1.0, dtype=torch.float64), rtol=1e-6, atol=0)
    torch.testing.assert_close(standardize(unit * x + shift), plain, rtol=1e-6, atol=1e-8)
    order = torch.randperm(len(x), generator=torch.Generator().manual_seed(seed))
    torch.testing.assert_close(standardize(x[order]), plain[order])
    padded = torch.cat([x, torch.full((3,), float("nan"))])
    mask = torch.arange(len(padded)) < len(x)
    torch.testing.assert_close(standardize(padded, mask)[: len(x)], plain)
    torch.testing.assert_close(explained_variance(padded, padded + 1, mask), torch.tensor(1.0, dtype=torch.float64))
    assert float(explained_variance(torch.zeros_like(x), x)) < 1e-9


@given(numbers, st.floats(0.01, 0.9), st.floats(-5, 5))
def test_surrogates_are_pessimistic(log_ratio: Any, clip: float, advantage: float):
    log_ratio, weight = log_ratio / 5, torch.full_like(log_ratio, advantage)
    clipped = clip_surrogate(log_ratio, weight, clip)
    assert (clipped <= log_ratio.exp() * weight + 1e-12).all()
    within = log_ratio.exp().clamp(1 - clip, 1 + clip) * weight
    assert (clipped <= within + 1e-12).all()
    assert torch.equal(clip_surrogate(torch.zeros_like(weight), weight, clip), weight)
    assert (approx_kl(log_ratio) >= 0).all()


@given(numbers, st.floats(0.01, 5), st.sampled_from(["l2", "l1", "smooth_l1"]))
def test_a_clipped_value_loss_is_never_smaller(value: Any, clip: float, kind: str):
    target, old = value.flip(0), value.roll(1)
    assert (clipped_value_loss(value, target, old, clip, kind) >= value_loss(value, target, kind)).all()
    assert torch.equal(clipped_value_loss(value, target, value, clip, kind), value_loss(value, target, kind))


@given(numbers, st.integers(2, 4), st.floats(-10, 10))
def test_scores_of_a_group_are_relative(score: Any, size: int, shift: float):
    score = score.repeat(size)[: size * len(score) // size * size]
    score = score[: len(score) // size * size]
    plain = group_relative(score, size, divide=False)
    assert plain.unflatten(0, (-1, size)).mean(1).abs().max() < 1e-9
    torch.testing.assert_close(group_relative(score + shift, size, divide=False), plain, rtol=1e-9, atol=1e-9)


@given(numbers, st.integers(2, 60))
def test_projected_distributions_keep_mass_and_mean(value: Any, bins: int):
    support = torch.linspace(-60, 60, bins, dtype=torch.float64)
    weights = two_hot(value, support)
    torch.testing.assert_close(weights.sum(-1), torch.ones_like(value))
    torch.testing.assert_close((weights * support).sum(-1), value, rtol=1e-6, atol=1e-6)
    atoms, mass = value.expand(2, -1), torch.full((2, len(value)), 1 / len(value), dtype=torch.float64)
    projected = categorical_projection(atoms, mass, support)
    torch.testing.assert_close(projected.sum(-1), torch.ones(2, dtype=torch.float64))
    torch.testing.assert_close((projected * support).sum(-1), value.mean().expand(2), rtol=1e-6, atol=1e-6)


@given(st.integers(0, 2**31), st.lists(st.integers(1, 40), min_size=1, max_size=5), st.floats(0.01, 100))
def test_moments_do_not_depend_on_how_samples_are_split(seed: int, sizes: list[int], unit: float):
    x = unit * torch.randn(sum(sizes), 3, generator=torch.Generator().manual_seed(seed))
    moments = modules.normalizers.RunningMoments((3,))
    for part in x.split(sizes):
        moments.update(part)
    torch.testing.assert_close(moments.mean, x.mean(0), rtol=1e-4, atol=1e-4 * unit)
    torch.testing.assert_close(moments.var, x.var(0, correction=0), rtol=1e-3, atol=1e-5 * unit**2)
    normalizer = modules.ObsNormalizer((3,))
    normalizer.update(x)
    assert normalizer(1e9 * x).abs().max() <= 10
