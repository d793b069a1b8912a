"""What actors and critics share: a normalizer, then hidden layers or an encoder, then a head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from pgkit.errors import UserError
from pgkit.functional.modes import in_evaluation
from pgkit.modules.groups import AgentIds, Agents, AllAgents, ForEachAgent
from pgkit.modules.mlp import mlp
from pgkit.modules.sizes import flat_size, observation_spec

Centralized = bool | NestedKey


class Trunk(NamedTuple):
    """What comes before a head.

    Attributes:
        layers: modules from the observation's entries to features ``[*B, features]``, of a group ``[*B, agents, ...]``.
        features: their number.
        keys: the entries that are read.
        states: entries that a recurrent encoder writes besides.
        after: modules that follow the head.
    """

    layers: list[nn.Module]
    features: int
    keys: list[NestedKey]
    states: list[NestedKey]
    after: list[nn.Module]


def trunk(
    who: Agents,
    hidden: Sequence[int],
    activation: type[nn.Module],
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    centralized: Centralized = False,
) -> Trunk:
    """The modules before a head: normalizer, all agents' observations side by side, agent ids, hidden layers.

    An encoder stands in place of the hidden layers, right after the normalizer. Without one, a matrix is flattened.
    """
    key = who.key("observation") if isinstance(centralized, bool) else centralized
    before = [] if normalizer is None else [normalizer]
    between, after, width = _team(who, centralized)
    if encoder is None:
        shape = who.observation(key).shape
        if len(shape) == 2:
            before, shape = [*before, FlatMatrix()], (shape.numel(),)
        size = width * flat_size(shape, key) + who.number * who.ids
        layers = mlp(size, None, hidden, activation, linear=who.linear)
        return Trunk([*before, *between, layers], list(hidden)[-1] if hidden else size, [key], [], after)
    keys, states = reads(encoder, key), list(getattr(encoder, "out_keys", []))
    if normalizer is not None and keys != [key]:
        raise UserError(
            f"normalizer= is for the one entry '{key}', the encoder reads {', '.join(map(str, keys))}: "
            "put normalizers into the encoders of single entries (nn.Sequential(normalizer, encoder))"
        )
    if states and between:
        raise UserError("agent_ids= and centralized= go to the recurrent encoder's builder, which comes first")
    features = width * _features(who, encoder, keys) + who.number * who.ids
    return Trunk([*before, encoder, *between], features, keys, states, after)


class FlatMatrix(nn.Module):
    """Matrices ``[*B, rows, columns]`` as vectors ``[*B, rows * columns]``; bytes become floats."""

    def forward(self, x: Tensor) -> Tensor:
        return (x if x.is_floating_point() else x.to(torch.get_default_dtype())).flatten(-2)


def headed(
    body: Trunk,
    head: nn.Module,
    out_keys: Sequence[NestedKey],
    head_keys: Sequence[NestedKey] = (),
    states: bool = True,
) -> TensorDictModule:
    """The network of a trunk and a head as a TensorDict module.

    Args:
        body: what comes before the head.
        head: from features to what ``out_keys`` name.
        out_keys: entries that it writes.
        head_keys: further inputs of the head.
        states: write a recurrent encoder's state too.
    """
    if not head_keys and len(body.keys) == 1:
        net = nn.Sequential(*body.layers, head, *body.after)
        return TensorDictModule(net, in_keys=body.keys, out_keys=[*out_keys])
    encoder = body.layers[0] if len(body.layers) == 1 else nn.Sequential(*body.layers)
    written = body.states if states else []
    net = Headed(encoder, nn.Sequential(head, *body.after) if body.after else head, len(body.keys), len(written))
    return TensorDictModule(net, in_keys=[*body.keys, *head_keys], out_keys=[*out_keys, *written])


class Headed(nn.Module):
    """An encoder of ``inputs`` tensors and a head of its features; a recurrent encoder's ``states`` come out last."""

    def __init__(self, encoder: nn.Module, head: nn.Module, inputs: int, states: int) -> None:
        super().__init__()
        self.encoder, self.head, self.inputs, self.states = encoder, head, inputs, states

    def forward(self, *inputs: Tensor) -> Any:
        encoded = self.encoder(*inputs[: self.inputs])
        out = self.head(first(encoded), *inputs[self.inputs :])
        return (*(out if isinstance(out, tuple) else (out,)), *encoded[1:]) if self.states else out


def reads(encoder: nn.Module, default: NestedKey) -> list[NestedKey]:
    """Entries an encoder is called with: its ``in_keys``, or the observation."""
    return list(getattr(encoder, "in_keys", [default]))


def first(out: Any) -> Tensor:
    """The features among an encoder's results."""
    return out[0] if isinstance(out, tuple) else out


def _team(who: Agents, centralized: Centralized) -> tuple[list[nn.Module], list[nn.Module], int]:
    """Modules between the observation and the hidden layers, those after the head, and how many observations count."""
    if centralized is not False and who.name is None:
        raise UserError("centralized= is for a group of agents, the environment has one agent")
    if not isinstance(centralized, bool | str) and centralized[0] == who.name:
        raise UserError(
            f"centralized={centralized}: that is each agent's own, in the group '{who.name}': centralized=True reads "
            "all agents' observations, a key at the root names a state that they share"
        )
    ids: list[nn.Module] = [AgentIds(who.number)] if who.ids else []
    if centralized is False:
        return ids, [], 1
    each = who.ids or who.several  # the agents' values differ
    gather = AllAgents(who.number if each else 1, flatten=centralized is True)
    return [gather, *ids], [] if each else [ForEachAgent(who.number)], who.number if centralized is True else 1


def _features(who: Agents, encoder: Any, keys: Sequence[NestedKey]) -> int:
    """How many features an encoder gives for an observation."""
    device = next((p.device for p in encoder.parameters()), who.device)
    examples = [_zero(who, encoder, key).to(device) for key in keys]
    try:
        with torch.no_grad(), in_evaluation(encoder):  # a batch of zeros is no statistic
            out = first(encoder(*examples))
    except (RuntimeError, ValueError, TypeError) as error:
        found = ", ".join(str(tuple(x.shape)) for x in examples)
        raise UserError(
            f"encoder={type(encoder).__name__} cannot take an observation {found}: {str(error).splitlines()[0]}"
        ) from error
    size = (1,) if who.name is None or isinstance(keys[0], str) else (1, who.number)
    if out.shape[:-1] != size:
        raise UserError(
            f"encoder={type(encoder).__name__} gives {tuple(out.shape)} for an observation "
            f"{tuple(examples[0].shape)}, expected {(*size, 'features')}: flatten what it gives (nn.Flatten)"
        )
    if out.device.type != (who.device or out.device).type:
        raise UserError(
            f"encoder={type(encoder).__name__} lies on {out.device}, the rest is built on {who.device}: give "
            f"device='{out.device}', or move the encoder before the optimizer is built"
        )
    return out.shape[-1]


def _zero(who: Agents, encoder: Any, key: NestedKey) -> Tensor:
    """An example ``[1, ...]`` of what an encoder reads."""
    name = key if isinstance(key, str) else key[-1]
    if name == "is_init":
        return torch.ones(1, 1, dtype=torch.bool)
    if name == "recurrent_state":
        return torch.zeros(1, *([] if isinstance(key, str) else [who.number]), encoder.state_size)
    return observation_spec(who.env, key).zero().unsqueeze(0)
