"""Values derived by hand, and a float64 loop over time."""

import pytest
import torch

from pgkit.functional import discounted_sum, generalized_advantage, lambda_return, n_step_return, vtrace


def column(*values, dtype=torch.float64):
    return torch.tensor(values, dtype=dtype).unsqueeze(-1)


def test_truncation_in_mid_batch_by_hand():
    # gamma 0.5, lambda 0.5, four steps; step 1 is a truncation, step 3 a termination.
    # delta_0 = 1 + .5*20 - 10 = 1      delta_1 = 2 + .5*30 - 20 = -3 (bootstraps: V(final) = 30)
    # delta_2 = 3 + .5*50 - 40 = -12    delta_3 = 4 + 0 - 50 = -46    (terminal: V(final) = 60 is not used)
    # A_3 = -46, A_2 = -12 + .25*-46 = -23.5, A_1 = -3 (the trace stops), A_0 = 1 + .25*-3 = 0.25
    advantage, target = generalized_advantage(
        value=column(10.0, 20.0, 40.0, 50.0),
        next_value=column(20.0, 30.0, 50.0, 60.0),
        reward=column(1.0, 2.0, 3.0, 4.0),
        done=column(False, True, False, True, dtype=torch.bool),
        terminated=column(False, False, False, True, dtype=torch.bool),
        gamma=0.5,
        lmbda=0.5,
    )
    assert torch.equal(advantage, column(0.25, -3.0, -23.5, -46.0))
    assert torch.equal(target, column(10.25, 17.0, 16.5, 4.0))


@pytest.mark.parametrize("steps", [1, 2, 3, 7, 64, 100])
def test_scan_equals_loop(steps):
    torch.manual_seed(0)
    x, factor = torch.randn(3, steps, 1, dtype=torch.float64), torch.rand(3, steps, 1, dtype=torch.float64)
    expected, y = torch.empty_like(x), torch.zeros(3, 1, dtype=torch.float64)
    for t in reversed(range(steps)):
        y = x[:, t] + factor[:, t] * y
        expected[:, t] = y
    torch.testing.assert_close(discounted_sum(x, factor), expected, rtol=1e-12, atol=1e-12)


def test_value_of_an_endless_chain():
    # one state, reward 1, never terminal, truncated every 5 steps: V = 1 / (1 - gamma) is a fixed point
    gamma = 0.9
    value = torch.full((1, 20, 1), 1 / (1 - gamma), dtype=torch.float64)
    done = torch.zeros(1, 20, 1, dtype=torch.bool)
    done[:, 4::5] = True
    flat = generalized_advantage(value, value, torch.ones_like(value), done, torch.zeros_like(done), gamma, 0.95)[0]
    assert flat.abs().max() < 1e-12
    ended = generalized_advantage(value, value, torch.ones_like(value), done, done, gamma, 0.95)[0]
    assert ended[:, 4] == pytest.approx(1 - 10)  # as a termination it would lose the future


def test_shapes_never_broadcast():
    x = torch.zeros(2, 4, 1)
    flag = torch.zeros(2, 4, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"reward has shape \(2, 4\) but value has shape \(2, 4, 1\)"):
        generalized_advantage(x, x, x.squeeze(-1), flag, flag, 0.9, 0.9)
    with pytest.raises(TypeError, match="terminated must be boolean"):
        generalized_advantage(x, x, x, flag, x, 0.9, 0.9)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("terminated", [True, False])
def test_what_is_not_finite_after_an_end_does_not_reach_the_episode_before_it(bad, terminated):
    torch.manual_seed(0)
    value, after, reward = (torch.randn(1, 9, 1, dtype=torch.float64) for _ in range(3))
    done = torch.zeros(1, 9, 1, dtype=torch.bool)
    done[:, 4] = True
    ended = done & terminated
    dirty_value, dirty_after, dirty_reward = value.clone(), after.clone(), reward.clone()
    for x in (dirty_value, dirty_after, dirty_reward):
        x[:, 5:] = bad
    if terminated:
        dirty_after[:, 4] = bad  # the value of a terminal state is not read

    def estimates(value, after, reward):
        yield from generalized_advantage(value, after, reward, done, ended, 0.9, 0.8)
        yield lambda_return(after, reward, done, ended, 0.9, 0.8)
        yield n_step_return(after, reward, done, ended, 0.9, 3)
        yield from vtrace(torch.zeros_like(value), value, after, reward, done, ended, 0.9, 0.8)

    pairs = zip(estimates(value, after, reward), estimates(dirty_value, dirty_after, dirty_reward), strict=True)
    for clean, dirty in pairs:
        torch.testing.assert_close(clean[:, :5], dirty[:, :5], rtol=0, atol=0)
        assert not dirty[:, 5:].isfinite().any()  # it is not hidden either
