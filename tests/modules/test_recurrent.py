import pytest
import torch
from torch import nn

from pgkit import envs, modules
from pgkit.modules.recurrent import GRUCell, LSTMCell, Recurrent


def test_cells_are_torchs():
    # the same weights in torch's cells, whose gates lie in the same order
    torch.manual_seed(0)
    x, h, c = (torch.randn(6, n, dtype=torch.float64) for n in (3, 4, 4))
    for ours, theirs in ((GRUCell(3, 4), nn.GRUCell(3, 4)), (LSTMCell(3, 4), nn.LSTMCell(3, 4))):
        ours, theirs = ours.double(), theirs.double()
        ours.input.weight, ours.input.bias = theirs.weight_ih, theirs.bias_ih
        ours.recurrent.weight, ours.recurrent.bias = theirs.weight_hh, theirs.bias_hh
        if isinstance(theirs, nn.GRUCell):
            state, expected = h, theirs(x, h)
        else:
            state, expected = torch.cat([h, c], -1), torch.cat(theirs(x, (h, c)), -1)
        torch.testing.assert_close(ours(ours.input(x), state), expected)


@pytest.fixture(params=[modules.gru, modules.lstm])
def core(request) -> Recurrent:
    torch.manual_seed(0)
    return request.param(envs.make("CartPole-v1"), 5, (6,)).double()


def sequence(core: Recurrent, resets: tuple[int, ...] = ()):
    g = torch.Generator().manual_seed(1)
    x, state = (torch.randn(2, 7, n, generator=g, dtype=torch.float64) for n in (4, core.state_size))
    is_init = torch.zeros(2, 7, 1, dtype=torch.bool)
    is_init[:, list(resets)] = True
    return x, is_init, state


def test_a_sequence_is_its_steps(core):
    x, is_init, state = sequence(core, resets=(3,))
    features, states = core(x, is_init, state)
    carried = state[:, 0]
    for t in range(7):
        feature, carried = core(x[:, t], is_init[:, t], carried)
        torch.testing.assert_close(features[:, t], feature)
        torch.testing.assert_close(states[:, t], carried)
    assert features.shape == (2, 7, 5)


def test_an_episode_begins_with_an_empty_memory(core):
    # what comes from a reset on is a sequence of its own, begun at zero: nothing before it counts
    x, is_init, state = sequence(core, resets=(3,))
    features, _ = core(x, is_init, state)
    alone, _ = core(x[:, 3:], torch.zeros_like(is_init[:, 3:]), torch.zeros_like(state[:, 3:]))
    torch.testing.assert_close(features[:, 3:], alone)
    carried_on, _ = core(x, torch.zeros_like(is_init), state)
    assert (features[:, 3:] - carried_on[:, 3:]).abs().amax(-1).min() > 1e-3  # it would be seen
    x.requires_grad_()
    (grad,) = torch.autograd.grad(core(x, is_init, state)[0][:, 3:].sum(), x)
    assert (grad[:, :3] == 0).all() and (grad[:, 3] != 0).all()


def test_gradients_flow_back_through_a_sequence(core):
    x, is_init, state = sequence(core)
    x.requires_grad_()
    (grad,) = torch.autograd.grad(core(x, is_init, state)[0][:, -1].sum(), x)
    assert (grad.abs().sum(-1) > 0).all()
