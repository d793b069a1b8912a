"""Hidden layers of an ensemble: ``(num, features) -> (modules that read [num, B, features], features they give)``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import inf

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.modules.ensemble import (
    EnsembleBatchRenorm,
    EnsembleDropout,
    EnsembleLayerNorm,
    EnsembleLinear,
    EnsembleRMSNorm,
)
from pgkit.modules.groups import agents
from pgkit.modules.sizes import flat_size, layer_sizes

Layers = tuple[list[nn.Module], int]
Body = Callable[[int, int], Layers]
Norm = Callable[[int, int], nn.Module]


def ensemble_mlp(
    num: int,
    features: int,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    norm: Norm | None = None,
    dropout: float = 0.0,
) -> Layers:
    """Perceptrons; a layer is linear, dropout, norm, activation (DroQ's order, https://arxiv.org/abs/2110.02034).

    Args:
        num: members.
        features: size of the input.
        hidden: sizes of the layers.
        activation: class of the activation.
        norm: ``(num, features) -> module``, e.g. :class:`~pgkit.modules.EnsembleLayerNorm`; None: none.
        dropout: probability of a zero, drawn for every member, row and unit.
    """
    layers: list[nn.Module] = []
    for size in layer_sizes(hidden):
        layers.append(EnsembleLinear(num, features, size, gain=2**0.5))
        layers += [EnsembleDropout(dropout)] if dropout else []
        layers += [norm(num, size)] if norm else []
        layers.append(activation())
        features = size
    return layers, features


def batch_renorm_mlp(
    num: int,
    features: int,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    norm: Norm = EnsembleBatchRenorm,
) -> Layers:
    """Perceptrons with batch renormalization of the input and after each activation, as in CrossQ.

    Bhatt et al., 2024 (https://arxiv.org/abs/1902.05605). Arguments as in :func:`ensemble_mlp`.
    """
    layers: list[nn.Module] = [norm(num, features)]
    for size in layer_sizes(hidden):
        layers += [EnsembleLinear(num, features, size, gain=2**0.5), activation(), norm(num, size)]
        features = size
    return layers, features


def simba(num: int, features: int, width: int = 256, blocks: int = 2, expansion: int = 4) -> Layers:
    """A residual encoder: linear, ``blocks`` residual blocks, layer norm.

    SimBa (Lee et al., 2024, https://arxiv.org/abs/2410.09754); its observations are normalized by running statistics:
    give :func:`~pgkit.modules.q_value` an ``ObsNormalizer`` as well.

    Args:
        num: members.
        features: size of the input.
        width: size of the residual stream.
        blocks: how many blocks.
        expansion: a block's hidden layer is so many times as wide.
    """
    layers: list[nn.Module] = [EnsembleLinear(num, features, width, gain=1.0)]
    layers += [ResidualBlock(num, width, expansion * width) for _ in range(blocks)]
    return [*layers, EnsembleLayerNorm(num, width)], width


class ResidualBlock(nn.Module):
    """``x + linear(relu(linear(layer_norm(x))))``, ``[num, B, width]`` to the same."""

    def __init__(self, num: int, width: int, hidden: int) -> None:
        super().__init__()
        self.norm = EnsembleLayerNorm(num, width)
        self.inner = EnsembleLinear(num, width, hidden, gain=2**0.5)
        self.outer = EnsembleLinear(num, hidden, width, gain=1.0)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.outer(torch.relu(self.inner(self.norm(x))))


def flash(num: int, features: int, width: int = 256, blocks: int = 2, expansion: int = 4) -> Layers:
    """A residual encoder with batch normalization: norm, linear, ``blocks`` residual blocks, RMS norm.

    FlashSAC (2026, https://arxiv.org/abs/2604.04539). Its linear layers have no biases, and its weights are to stay on
    a sphere: :class:`~pgkit.modules.WeightProjection`. The input's batch norm stands in place of an ``ObsNormalizer``.

    Args:
        num, features, width, blocks, expansion: as in :func:`simba`.
    """
    layers: list[nn.Module] = [_batch_norm(num, features), EnsembleLinear(num, features, width, gain=1.0, bias=False)]
    layers += [BatchNormBlock(num, width, expansion * width) for _ in range(blocks)]
    return [*layers, EnsembleRMSNorm(num, width)], width


class BatchNormBlock(nn.Module):
    """``x + relu(norm(linear(relu(norm(linear(x))))))``, ``[num, B, width]`` to the same."""

    def __init__(self, num: int, width: int, hidden: int) -> None:
        super().__init__()
        self.inner = EnsembleLinear(num, width, hidden, gain=1.0, bias=False)
        self.inner_norm = _batch_norm(num, hidden)
        self.outer = EnsembleLinear(num, hidden, width, gain=1.0, bias=False)
        self.outer_norm = _batch_norm(num, width)

    def forward(self, x: Tensor) -> Tensor:
        hidden = torch.relu(self.inner_norm(self.inner(x)))
        return x + torch.relu(self.outer_norm(self.outer(hidden)))


_batch_norm = partial(EnsembleBatchRenorm, eps=1e-5, warmup=inf)


class Encoder(nn.Module):
    """A body for one network, to be an actor's ``encoder=``: ``[*B, obs] -> [*B, features]``.

    Args:
        env: its observation gives the size of the input.
        body: ``(num, features) -> layers``, e.g. ``partial(modules.simba, width=128, blocks=1)``.
        group, device: as in :func:`~pgkit.modules.gaussian_actor`; a group's agents share the network.
    """

    def __init__(
        self, env: EnvBase, body: Body, *, group: str | None = None, device: torch.device | str | None = None
    ) -> None:
        super().__init__()
        who = agents(env, group, device=device)
        key = who.key("observation")
        layers, self.features = body(1, flat_size(who.observation(key).shape, key))
        self.layers = nn.Sequential(*layers).to(who.device)

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x.reshape(1, -1, x.shape[-1])).reshape(*x.shape[:-1], self.features)
