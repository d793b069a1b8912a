"""Multilayer perceptrons with per-layer orthogonal gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import nn

from pgkit.modules.sizes import layer_sizes

Layer = TypeVar("Layer", bound=nn.Module)
Linear = Callable[[int, int, Any], nn.Module]  # (inputs, outputs, gain); gain None: torch's initialization


def mlp(
    in_features: int,
    out_features: int | None,
    hidden: Sequence[int] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    *,
    layer_norm: bool = False,
    hidden_gain: float = 2**0.5,
    out_gain: float = 1.0,
    linear: Linear | None = None,
) -> nn.Sequential:
    """A multilayer perceptron, ``[*, in_features] -> [*, out_features]``, orthogonal weights and zero biases.

    Args:
        in_features: size of the input.
        out_features: size of the output; None leaves the last hidden layer, activated, as the output (an encoder).
        hidden: sizes of the hidden layers.
        activation: class of the activation.
        layer_norm: normalize before each activation.
        hidden_gain: gain of the hidden layers' orthogonal init.
        out_gain: gain of the last layer's; 0.01 keeps a new policy close to uniform or to its mean (Andrychowicz
            et al., 2021, https://arxiv.org/abs/2006.05990).
        linear: makes a linear layer, ``(inputs, outputs, gain) -> module``; by default an orthogonal one.
    """
    linear = linear or (lambda inputs, outputs, gain: orthogonal(nn.Linear(inputs, outputs), gain))
    layers: list[nn.Module] = []
    for size in layer_sizes(hidden):
        layers.append(linear(in_features, size, hidden_gain))
        layers += [nn.LayerNorm(size), activation()] if layer_norm else [activation()]
        in_features = size
    if out_features is not None:
        layers.append(linear(in_features, out_features, out_gain))
    return nn.Sequential(*layers)


def orthogonal(layer: Layer, gain: float) -> Layer:
    """Initializes a linear layer or a convolution in place: orthogonal weight times ``gain``, zero bias."""
    nn.init.orthogonal_(layer.weight, gain)
    torch.nn.init.zeros_(layer.bias)
    return layer
