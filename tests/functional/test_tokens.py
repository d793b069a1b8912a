"""What is taken over the tokens that a mask keeps, by hand; whatever is outside must not count."""

import pytest
import torch

from pgkit.functional import batch_relative, has_spread, kl_estimate, leave_one_out, sequence_log_ratio, token_weights

# rows of 1 and 3 tokens, and one that was dropped
MASK = torch.tensor([[0, 1, 0, 0], [0, 1, 1, 1], [0, 0, 0, 0]]).bool()


@pytest.mark.parametrize(
    ("aggregation", "first", "second"),
    [("token", 1 / 4, 1 / 4), ("sequence", 1 / 2, 1 / 6), ("constant", 1 / 8, 1 / 8)],  # 4 tokens; 2 rows; 2 rows of 4
)
def test_weights_of_an_aggregation(aggregation, first, second):
    expected = torch.tensor([[0, first, 0, 0], [0, second, second, second], [0, 0, 0, 0]])
    torch.testing.assert_close(token_weights(MASK, aggregation), expected)


def test_the_constant_may_be_given_and_an_empty_batch_weighs_nothing():
    assert token_weights(MASK, "constant", 10)[1, 1] == pytest.approx(1 / 20)
    for aggregation in ("token", "sequence", "constant"):
        assert token_weights(torch.zeros_like(MASK), aggregation).eq(0).all()
    with pytest.raises(ValueError, match="aggregation='mean': give 'token', 'sequence' or 'constant'"):
        token_weights(MASK, "mean")
    with pytest.raises(TypeError, match="mask must be boolean"):
        token_weights(MASK.float())


def test_a_sequence_s_ratio_is_the_geometric_mean_of_its_tokens():
    log_ratio = torch.tensor([[9.0, 0.5, 9, 9], [9, 0.1, 0.2, 0.6], [9, 9, 9, 9]])
    # 0.5; (0.1 + 0.2 + 0.6) / 3 = 0.3; nothing
    expected = torch.tensor([0.5, 0.3, 0.0]).unsqueeze(-1).expand(3, 4)
    torch.testing.assert_close(sequence_log_ratio(log_ratio, MASK), expected)


@pytest.mark.parametrize(("kind", "value"), [("k1", 0.5), ("k2", 0.125), ("k3", 0.1065307)])
def test_divergences(kind, value):
    # d = log pi_ref - log pi = -1/2: -d; d^2 / 2; e^-1/2 - (-1/2) - 1
    assert kl_estimate(torch.tensor(-0.5), kind).item() == pytest.approx(value, rel=1e-6)


def test_k1_and_k3_are_unbiased_and_k2_has_the_gradient_of_the_divergence():
    # two outcomes, pi = (p, 1 - p), reference (1/4, 3/4): sums over the outcomes are exact
    logit = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    log_pi = torch.stack([torch.nn.functional.logsigmoid(logit), torch.nn.functional.logsigmoid(-logit)])
    d = torch.tensor([0.25, 0.75], dtype=torch.float64).log() - log_pi
    pi = log_pi.detach().exp()
    exact = (log_pi.exp() * -d).sum()
    for kind in ("k1", "k3"):
        torch.testing.assert_close((pi * kl_estimate(d, kind)).sum(), exact)
    (true,) = torch.autograd.grad(exact, logit, retain_graph=True)
    slopes = {k: torch.autograd.grad((pi * kl_estimate(d, k)).sum(), logit, retain_graph=True)[0] for k in ("k1", "k2")}
    torch.testing.assert_close(slopes["k2"], true)
    assert slopes["k1"].abs() < 1e-12  # as a loss it ignores the reference
    with pytest.raises(ValueError, match="kl='k4': give 'k1', 'k2' or 'k3'"):
        kl_estimate(d, "k4")


def test_advantages_against_the_others_and_over_the_batch():
    # groups (1, 3), (5, 5): others' means 3, 1, 5, 5
    score = torch.tensor([1.0, 3.0, 5.0, 5.0])
    assert leave_one_out(score, 2).tolist() == [-2, 2, 0, 0]
    # less the group's mean -1, 1, 0, 0; the batch's deviation: mean 3.5, squares 6.25 .25 2.25 2.25, sum 11, / 3
    torch.testing.assert_close(batch_relative(score, 2), torch.tensor([-1.0, 1, 0, 0]) / (11 / 3) ** 0.5)
    assert has_spread(score, 2).tolist() == [True, True, False, False]
    with pytest.raises(ValueError, match="not groups of 1"):
        leave_one_out(score, 1)
