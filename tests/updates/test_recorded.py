"""What a step may do and still be one compiled graph."""

import pytest
import torch

from pgkit.compiled.native import compile_record, record
from pgkit.errors import UserError
from tests.updates.test_on_policy import make_agent, make_rollout, parameters


def both(surrogate, rollouts, mode="auto"):
    """The same agent compiled and eager, after an update on each rollout; their metrics agree at each."""
    compiled, eager = (make_agent(compile=c, epochs=1, dtype=torch.float64) for c in (mode, "off"))
    for i, rollout in enumerate(rollouts):
        metrics = []
        for update in (compiled, eager):
            update.loss.surrogate = surrogate
            torch.manual_seed(i)
            metrics.append(update(rollout.clone()))
        assert metrics[0] == pytest.approx(metrics[1], rel=1e-4, abs=1e-6)
    torch.testing.assert_close(parameters(compiled), parameters(eager), rtol=0, atol=1e-5)
    return compiled


def rung(update):
    return update._plan.native[0].rung


def rollouts(count=4):
    return [make_rollout(i, torch.float64) for i in range(count)]


def test_a_branch_on_a_value_gets_a_graph_of_its_own():
    taken = []

    def surrogate(log_ratio, advantage):
        noise = 1 + 0.1 * torch.randn_like(log_ratio)  # a graph that is given up must give its random numbers back
        up = bool(noise.mean() > 1)
        taken.append(up)
        return noise * log_ratio.exp() * advantage if up else advantage.abs() * log_ratio

    compiled = both(surrogate, rollouts())
    assert set(taken) == {True, False}
    assert rung(compiled) == "recorded and compiled"


def test_more_branches_than_graphs_run_as_they_are(monkeypatch):
    monkeypatch.setattr("pgkit.compiled.recorded._MOST_GRAPHS", 1)
    taken = set()

    def surrogate(log_ratio, advantage):
        count = sum(bool(advantage.max() > threshold) for threshold in (1.8, 2.0, 2.2, 2.4, 2.6))
        taken.add(count)
        return (1 + 0.1 * count) * log_ratio.exp() * advantage

    compiled = both(surrogate, rollouts(3))
    assert len(taken) > 2
    assert rung(compiled) == "recorded and compiled"


def test_a_number_that_stays_is_recorded():
    ends = torch.tensor([-2.0, 2.0])

    def surrogate(log_ratio, advantage):
        return log_ratio.clamp(ends.min().item(), ends.max().item()).exp() * advantage

    assert rung(both(surrogate, rollouts(1))) == "recorded and compiled"


@pytest.mark.parametrize(
    "surrogate",
    [
        lambda log_ratio, advantage: log_ratio.exp() * advantage / float(advantage.detach().abs().max()),
        lambda log_ratio, advantage: (log_ratio.exp() * advantage)[advantage > 0].mean().expand_as(advantage),
    ],
    ids=["a number that changes", "as many rows as the values say"],
)
def test_what_cannot_be_recorded_goes_to_torch_compile(surrogate):
    assert rung(both(surrogate, rollouts(1), mode="on")) == "torch.compile"


def test_what_cannot_be_compiled_runs_without(caplog):
    def surrogate(log_ratio, advantage):
        return log_ratio.exp() * advantage * (2.0 if float(advantage.max()) > 2 else 1.0)

    assert rung(both(surrogate, rollouts(1))) == "eager"
    assert "the update cannot be compiled and runs without, several times slower" in caplog.text
    with pytest.raises(UserError, match="the update cannot be compiled .*compile='auto' runs it without"):
        both(surrogate, rollouts(1), mode="on")


def test_decisions_outside_torch_are_not_recorded():
    def surrogate(log_ratio, advantage):
        sign = 1.0 if advantage.detach().numpy()[0] > 0 else -1.0
        return sign * log_ratio.exp() * advantage

    assert rung(both(surrogate, rollouts(1))) != "recorded and compiled"


def test_a_tensor_that_is_written_behind_the_step_s_back_is_not_recorded():
    seen = torch.zeros(4)

    def surrogate(log_ratio, advantage):
        with torch.no_grad():
            seen.view(2, 2)[0] += 1
        return log_ratio.exp() * advantage

    assert rung(both(surrogate, rollouts(1), mode="on")) == "torch.compile"
    eager, compiled = 5, 5  # the trial of the wiring check, and 4 minibatches, of each agent
    assert seen[0] >= eager + compiled


def test_masked_assignments_are_recorded_for_all_elements():
    def assign(x, u):
        x = x + 1
        x[(u > 0) & (x == u)] -= 1
        x[u > 2] *= u.mean()
        x[u > 3] = 7
        x[u.long()] += 1  # indices, not a mask
        return x

    x, u = torch.tensor([0.0, 0, 1, 2]), torch.tensor([1.0, 1, 3, 3])
    code = compile_record(record(lambda x, u: [assign(x, u)], [x, u]), [x, u])
    for inputs in ((x, u), (u, x), (torch.tensor([5.0, 0, 2, 1]), torch.tensor([3.0, 1, 0, 2]))):
        torch.testing.assert_close(code([*inputs])[0], assign(*inputs))


@pytest.mark.parametrize("where", [lambda mask: mask, lambda mask: (slice(None), mask.long()), lambda mask: (mask, 0)])
def test_other_indices_are_left_alone(where):
    """A mask of rows, indices of columns, a mask beside an index: a square keeps a wrong rewrite from raising."""
    x, mask = torch.arange(9.0).view(3, 3), torch.tensor([True, False, True])

    def assign(x, mask):
        x = x + 0
        x[where(mask)] -= 1
        return x

    graph = record(lambda *inputs: [assign(*inputs)], [x, mask])
    torch.testing.assert_close(graph(x, mask)[0], assign(x, mask))
