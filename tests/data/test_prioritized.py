"""Prioritized draws: the tree, the probabilities, the weights, the write-back."""

import pytest
import torch

from pgkit import data, envs
from pgkit.data.sum_tree import SumTree
from pgkit.errors import UserError
from tests.data.test_replay import hand_made


def test_tree_finds_what_a_running_sum_finds():
    generator = torch.Generator().manual_seed(0)
    tree, numbers = SumTree(5_000), torch.zeros(5_000, dtype=torch.float64)
    for _ in range(20):
        index = torch.randint(5_000, (64,), generator=generator).unique()
        value = torch.rand(len(index), generator=generator, dtype=torch.float64)
        tree.set(index, value)
        numbers[index] = value
    share = torch.rand(2_000, generator=generator, dtype=torch.float64)
    assert torch.equal(tree.find(share), torch.searchsorted(numbers.cumsum(0), share * numbers.sum(), right=True))
    assert (numbers[tree.find(torch.tensor([0.0, 1 - 1e-16]))] > 0).all()


def test_probabilities_and_weights():
    # priorities 1, 2, 4, 1 (alpha 1, eps 0) of total 8; weights (p / p_min)^-0.5 = 1, 0.7071, 0.5, 1
    sampler = data.Prioritized(alpha=1.0, beta=0.5, eps=0.0)
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 10, sampler=sampler, seed=0)
    buffer.extend(hand_made([0, 1, 2, 3, 4], [1, 1, 1, 1]))
    index = torch.arange(4)
    errors = {"td_error": torch.tensor([1.0, -2.0, 4.0, 1.0])}
    buffer.write_back(buffer.data, index, errors)  # pyright: ignore[reportArgumentType]
    counts = torch.bincount(sampler.sample(8, 1_000, buffer.generator).flatten(), minlength=4)
    assert ((counts / 8_000 - torch.tensor([1, 2, 4, 1]) / 8).abs() < 0.02).all()
    weight = buffer.gather(1.0)(buffer.data, index)["priority_weight"]
    torch.testing.assert_close(weight, torch.tensor([1.0, 0.5**0.5, 0.5, 1.0]))


def test_errors_enter_with_eps_and_to_the_power_of_alpha():
    sampler = data.Prioritized(alpha=0.5, eps=1.0)
    sampler.begin(4)
    sampler.write_back(torch.arange(3), torch.tensor([0.0, -3.0, 8.0]))
    assert sampler.tree.values[:3].tolist() == [1.0, 2.0, 3.0]  # the roots of 0 + 1, 3 + 1, 8 + 1
    assert sampler.largest == 3.0


def test_new_frames_get_the_largest_priority_and_evicted_ones_are_never_drawn():
    sampler = data.Prioritized(alpha=1.0, eps=0.0)
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 10, sampler=sampler, n_steps=2, seed=0)
    buffer.extend(hand_made(list(range(9)), [1] * 8))
    buffer.write_back(buffer.data, torch.tensor([0]), {"td_error": torch.tensor([5.0])})  # pyright: ignore
    for first in (8, 12, 16):
        buffer.extend(hand_made(list(range(first, first + 5)), [1] * 4))
        drawn = (sampler.sample(1, 400, buffer.generator)[0] - buffer.start) % buffer.rows
        assert set(drawn.tolist()) == set(range(len(buffer)))
    newest = (buffer.start + len(buffer) - 1) % buffer.rows
    assert sampler.tree.values[newest] == 5.0


def test_priorities_that_are_not_finite_are_named():
    tree = SumTree(100)
    tree.set(torch.tensor([3]), float("nan"))
    with pytest.raises(UserError, match="priorities sum to nan: training diverged"):
        tree.find(torch.tensor([0.5]))


@pytest.mark.parametrize("n_steps", [1, 3])
def test_frames_that_come_with_an_error_get_its_priority_when_they_can_be_drawn(n_steps):
    """Two rollouts of 4 frames with errors 0 to 7; with 3-step returns the last two frames wait."""
    sampler = data.Prioritized(alpha=2.0, eps=1.0)
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 10, sampler=sampler, n_steps=n_steps)
    for first in (0, 4):
        rollout = hand_made(list(range(first, first + 5)), [1] * 4)
        buffer.extend(rollout.set("td_error", torch.arange(first, first + 4.0).view(1, 4)))
    ready = 8 - (n_steps - 1)
    assert sampler.tree.values[:8].tolist() == [(i + 1) ** 2.0 if i < ready else 0.0 for i in range(8)]
