"""Recurrent cores: encoders with a memory that begins anew with every episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.modules.groups import Agents, Share, agents
from pgkit.modules.mlp import Linear
from pgkit.modules.trunk import Trunk, trunk


def gru(
    env: EnvBase,
    size: int = 64,
    hidden: Sequence[int] = (64,),
    activation: type[nn.Module] = nn.Tanh,
    *,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    device: torch.device | str | None = None,
) -> Recurrent:
    """A gated recurrent unit over the features of an encoder (Cho et al., 2014, https://arxiv.org/abs/1406.1078).

    Give it as ``encoder=`` to the actor and, the same object, to the critic. The collector carries its state from step
    to step; an update with ``sequence_length=`` trains it.

    Args:
        env: any environment of pgkit.
        size: size of the state.
        hidden, activation, normalizer, encoder, group, share_parameters, agent_ids, device: what comes before it, as in
            :func:`gaussian_actor`. Of a group every agent has a state, ``("agents", "recurrent_state")``.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    body = trunk(who, hidden, activation, normalizer, encoder)
    return Recurrent(body, GRUCell(body.features, size, who.linear), who)


def lstm(
    env: EnvBase,
    size: int = 64,
    hidden: Sequence[int] = (64,),
    activation: type[nn.Module] = nn.Tanh,
    *,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    device: torch.device | str | None = None,
) -> Recurrent:
    """Long short-term memory (Hochreiter and Schmidhuber, 1997); otherwise as :func:`gru`."""
    who = agents(env, group, share_parameters, agent_ids, device)
    body = trunk(who, hidden, activation, normalizer, encoder)
    return Recurrent(body, LSTMCell(body.features, size, who.linear), who)


def _linear(inputs: int, outputs: int, gain: float | None = None) -> nn.Module:
    return nn.Linear(inputs, outputs)


class GRUCell(nn.Module):
    r"""One step, with :math:`i = W_i x + b_i` given for all steps at once and :math:`g = W_h h + b_h`.

    .. math::
        r = \sigma(i_r + g_r), \quad z = \sigma(i_z + g_z), \quad n = \tanh(i_n + r g_n), \quad
        h' = n + z (h - n)
    """

    def __init__(self, features: int, size: int, linear: Linear = _linear) -> None:
        super().__init__()
        self.size = self.state_size = size
        self.input, self.recurrent = linear(features, 3 * size, None), linear(size, 3 * size, None)

    def forward(self, given: Tensor, state: Tensor) -> Tensor:
        ir, iz, i_new = given.chunk(3, -1)
        gr, gz, g_new = self.recurrent(state).chunk(3, -1)
        new = torch.tanh(i_new + torch.sigmoid(ir + gr) * g_new)
        return new + torch.sigmoid(iz + gz) * (state - new)


class LSTMCell(nn.Module):
    r"""One step; the state is :math:`h` and :math:`c` side by side, :math:`a = W_i x + b_i + W_h h + b_h`.

    .. math::
        c' = \sigma(a_f) c + \sigma(a_i) \tanh(a_c), \quad h' = \sigma(a_o) \tanh(c')
    """

    def __init__(self, features: int, size: int, linear: Linear = _linear) -> None:
        super().__init__()
        self.size, self.state_size = size, 2 * size
        self.input, self.recurrent = linear(features, 4 * size, None), linear(size, 4 * size, None)

    def forward(self, given: Tensor, state: Tensor) -> Tensor:
        hidden, cell = state.chunk(2, -1)
        enter, forget, new, out = (given + self.recurrent(hidden)).chunk(4, -1)
        cell = torch.sigmoid(forget) * cell + torch.sigmoid(enter) * torch.tanh(new)
        return torch.cat([torch.sigmoid(out) * torch.tanh(cell), cell], -1)


class Recurrent(nn.Module):
    """An encoder, then a cell that runs over time; the state is put to zero wherever an episode begins.

    It reads the encoder's entries, ``is_init`` and ``recurrent_state``, and has two ways, told apart by the shape:

    - one step of ``N`` environments: ``is_init [N, 1]``, ``recurrent_state [N, state_size]``, the state after the step
      before;
    - sequences: ``is_init [B, L, 1]``, of ``recurrent_state [B, L, state_size]`` only the first step is read.

    Returns features ``[..., size]`` and the state after each step ``[..., state_size]``. Of a group, observations,
    features and states have a dimension of agents before the last, ``("agents", "recurrent_state") [N, agents, size]``;
    ``is_init`` is the environment's.

    Attributes:
        state_size: numbers in one state.
        state_shape: shape of an environment's states, ``(state_size,)`` or ``(agents, state_size)``.
        state_key: ``recurrent_state``, of a group below its name.
    """

    def __init__(self, body: Trunk, cell: Any, who: Agents) -> None:
        super().__init__()
        self.state_key = who.key("recurrent_state")
        self.in_keys = [*body.keys, "is_init", self.state_key]
        self.out_keys = [("next", *(["recurrent_state"] if who.name is None else [who.name, "recurrent_state"]))]
        self.encoder = body.layers[0] if len(body.layers) == 1 else nn.Sequential(*body.layers)
        self.cell, self.state_size = cell, cell.state_size
        self.state_shape = (*([] if who.name is None else [who.number]), cell.state_size)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        *entries, is_init, state = inputs
        one_step = is_init.ndim == 2
        if one_step:
            entries = [x.unsqueeze(1) for x in entries]
            is_init, state = is_init.unsqueeze(1), state.unsqueeze(1)
        rows, steps = is_init.shape[:2]
        is_init = is_init.reshape(rows, steps, *[1] * len(self.state_shape))
        features = self.encoder(*(x.flatten(0, 1) for x in entries))
        given = self.cell.input(features).unflatten(0, (rows, steps))
        state, states = state[:, 0], []
        for t in range(steps):
            state = self.cell(given[:, t], state.masked_fill(is_init[:, t], 0.0))
            states.append(state)
        out = states[0] if one_step else torch.stack(states, 1)
        return out[..., : self.cell.size], out
