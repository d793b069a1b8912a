"""Returns and V-trace: values by hand, a float64 loop over time."""

import math

import pytest
import torch

from pgkit.functional import (
    conjugate_gradient,
    from_start,
    generalized_advantage,
    group_relative,
    lambda_return,
    n_step_return,
    vtrace,
)


def column(*values, dtype=torch.float64):
    return torch.tensor(values, dtype=dtype).unsqueeze(-1)


# four steps; step 1 is a truncation, step 3 a termination
HAND = dict(
    next_value=column(20.0, 30.0, 50.0, 60.0),
    reward=column(1.0, 2.0, 3.0, 4.0),
    done=column(False, True, False, True, dtype=torch.bool),
    terminated=column(False, False, False, True, dtype=torch.bool),
)


def test_lambda_return_by_hand():
    # gamma 0.5, lambda 0.5. G_3 = 4 (terminal); G_2 = 3 + .5 (.5*50 + .5*4) = 16.5
    # G_1 = 2 + .5*30 = 17 (truncated: bootstraps);  G_0 = 1 + .5 (.5*20 + .5*17) = 10.25
    assert lambda_return(**HAND, gamma=0.5, lmbda=0.5).tolist() == column(10.25, 17.0, 16.5, 4.0).tolist()
    # lambda 1: G_2 = 3 + .5*4 = 5, G_0 = 1 + .5*17 = 9.5;   lambda 0: G_2 = 3 + 25, G_0 = 1 + 10
    assert lambda_return(**HAND, gamma=0.5, lmbda=1.0).tolist() == column(9.5, 17.0, 5.0, 4.0).tolist()
    assert lambda_return(**HAND, gamma=0.5, lmbda=0.0).tolist() == column(11.0, 17.0, 28.0, 4.0).tolist()


def test_n_step_return_by_hand():
    # 2 steps, gamma 0.5, all of one episode but its end: G_0 = 1 + .5*2 + .25*30, G_1 = 2 + .5*3 + .25*50
    # G_2 = 3 + .5*4 + .25*60 (the rollout's last two steps bootstrap after it), G_3 = 4 + .5*60
    no = torch.zeros(4, 1, dtype=torch.bool)
    got = n_step_return(HAND["next_value"], HAND["reward"], no, no, 0.5, 2)
    assert got.tolist() == column(9.5, 16.0, 20.0, 34.0).tolist()
    # with the ends: G_1 stops at the truncation, G_2 and G_3 at the termination
    assert n_step_return(**HAND, gamma=0.5, steps=2).tolist() == column(9.5, 17.0, 5.0, 4.0).tolist()


def test_from_start_by_hand():
    x = column(1.0, 2.0, 3.0, 4.0)
    assert from_start(x, column(False, True, False, False, dtype=torch.bool)).tolist() == column(1, 1, 3, 3.0).tolist()


def test_group_relative_by_hand():
    # 1, 3: mean 2, deviation sqrt(2); 5, 5: no spread, no preference
    got = group_relative(torch.tensor([1.0, 3.0, 5.0, 5.0]), 2)
    assert got.tolist() == pytest.approx([-1 / math.sqrt(2), 1 / math.sqrt(2), 0, 0], abs=1e-5)
    assert group_relative(torch.tensor([1.0, 3.0]), 2, divide=False).tolist() == [-1, 1]
    for wrong in (torch.zeros(3), torch.zeros(2, 1)):
        with pytest.raises(ValueError, match="not groups of 2"):
            group_relative(wrong, 2)


def test_vtrace_by_hand():
    # ratios 2, 1/2 with both thresholds 1, gamma 1/2, V = 10, 20, V(final) = 30, rewards 1, 2, no end
    # delta_1 = 1/2 (2 + 15 - 20) = -1.5, v_1 = 18.5; delta_0 = 1 + 10 - 10 = 1, v_0 = 10 + 1 + .5 * 1 * -1.5 = 10.25
    # A_1 = 1/2 (2 + 15 - 20) = -1.5;      A_0 = 1 (1 + .5 * 18.5 - 10) = 0.25
    no = torch.zeros(2, 1, dtype=torch.bool)
    value, after = column(10.0, 20.0), column(20.0, 30.0)
    got = vtrace(column(2.0, 0.5).log(), value, after, column(1.0, 2.0), no, no, 0.5)
    torch.testing.assert_close(got, (column(0.25, -1.5), column(10.25, 18.5)))
    # thresholds 3: rho = c = 2, 1/2: delta_0 = 2, v_0 = 10 + 2 + .5 * 2 * -1.5 = 10.5, A_0 = 2 * 0.25
    got = vtrace(column(2.0, 0.5).log(), value, after, column(1.0, 2.0), no, no, 0.5, 1.0, 3.0, 3.0)
    torch.testing.assert_close(got, (column(0.5, -1.5), column(10.5, 18.5)))


def trajectory(seed, steps=40, rows=3):
    g = torch.Generator().manual_seed(seed)
    draw = lambda: torch.randn(rows, steps, 1, generator=g, dtype=torch.float64)  # noqa: E731
    value, final, reward, log_ratio = draw(), draw(), draw(), 0.7 * draw()
    chance = torch.rand(rows, steps, 1, generator=g)
    terminated, truncated = chance < 0.1, chance > 0.9
    done = terminated | truncated
    cut = done.clone()
    cut[:, -1] = True
    next_value = torch.where(cut, final, torch.cat([value[:, 1:], final[:, -1:]], 1))
    return log_ratio, value, next_value, reward, done, terminated


def vtrace_loop(log_ratio, value, next_value, reward, done, terminated, gamma, lmbda, rho_bar, c_bar):
    """The sums of the paper, one row and one step after the other."""
    advantage, target = torch.empty_like(value), torch.empty_like(value)
    rows, steps, _ = value.shape
    for row in range(rows):
        excess = 0.0  # v_{t+1} - V(s_{t+1})
        for t in reversed(range(steps)):
            ratio = math.exp(log_ratio[row, t, 0])
            rho, c = min(rho_bar, ratio), lmbda * min(c_bar, ratio)
            r, v, after = (float(x[row, t, 0]) for x in (reward, value, next_value))
            future = 0.0 if terminated[row, t, 0] else gamma
            goes_on = t + 1 < steps and not done[row, t, 0]
            bootstrap = lmbda * float(target[row, t + 1, 0]) + (1 - lmbda) * after if goes_on else after
            advantage[row, t, 0] = rho * (r + future * bootstrap - v)
            excess = rho * (r + future * after - v) + (gamma * c * excess if goes_on else 0.0)
            target[row, t, 0] = v + excess
    return advantage, target


@pytest.mark.parametrize(
    ("lmbda", "rho_bar", "c_bar"), [(1.0, 1.0, 1.0), (0.9, 2.0, 0.7), (1.0, math.inf, math.inf), (0.5, 0.3, 1.0)]
)
@pytest.mark.parametrize("seed", range(5))
def test_vtrace_equals_a_loop(seed, lmbda, rho_bar, c_bar):
    data = trajectory(seed)
    assert data[-1].any() and (data[-2] & ~data[-1]).any()
    got = vtrace(*data, 0.97, lmbda, rho_bar, c_bar)
    for a, b in zip(got, vtrace_loop(*data, 0.97, lmbda, rho_bar, c_bar), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_vtrace_on_policy_without_clips_is_the_n_step_return(seed):
    _, *rest = trajectory(seed)
    value = rest[0]
    advantage, target = vtrace(torch.zeros_like(value), *rest, 0.97, 1.0, math.inf, math.inf)
    steps = value.shape[1]
    expected = n_step_return(*rest[1:], 0.97, steps)
    torch.testing.assert_close(target, expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(advantage, expected - value, rtol=1e-10, atol=1e-10)
    for a, b in zip(
        vtrace(torch.zeros_like(value), *rest, 0.97, 0.9), generalized_advantage(*rest, 0.97, 0.9), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_shapes_and_dtypes_are_refused():
    x, flag = torch.zeros(2, 4, 1), torch.zeros(2, 4, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"reward has shape \(2, 4\) but next_value has shape \(2, 4, 1\)"):
        lambda_return(x, x.squeeze(-1), flag, flag, 0.9, 0.9)
    with pytest.raises(TypeError, match="terminated must be boolean"):
        n_step_return(x, x, flag, x, 0.9, 3)
    with pytest.raises(ValueError, match=r"value has shape \(2, 4, 1\) but log_ratio has shape \(2, 4\)"):
        vtrace(x.squeeze(-1), x, x, x, flag, flag, 0.9)


def test_conjugate_gradient_solves_and_stops():
    # n steps solve n equations; a matrix of two distinct eigenvalues takes two
    g = torch.Generator().manual_seed(0)
    basis = torch.linalg.qr(torch.randn(6, 6, generator=g, dtype=torch.float64))[0]
    b = torch.randn(6, generator=g, dtype=torch.float64)
    for values, steps in ((torch.linspace(1, 50, 6), 6), (torch.tensor([1.0, 1, 1, 9, 9, 9]), 2)):
        matrix, calls = basis @ torch.diag(values.double()) @ basis.T, []
        x, error = conjugate_gradient(lambda v, m=matrix, c=calls: (c.append(1), m @ v)[1], b, steps=20)
        torch.testing.assert_close(matrix @ x, b, rtol=1e-4, atol=1e-4)
        assert len(calls) == steps and error < 1e-10
    assert not conjugate_gradient(lambda v: v, torch.zeros(3))[0].any()
