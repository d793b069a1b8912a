"""Encoders of images, and the decoder that reads their features."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded

from pgkit.errors import UserError
from pgkit.modules.groups import agents
from pgkit.modules.mlp import orthogonal

# kernel and stride of each layer, filters, features, what follows the last linear layer
_KINDS: dict[str, tuple[list[tuple[int, int]], list[int], int]] = {
    "drq": ([(3, 2), (3, 1), (3, 1), (3, 1)], [32, 32, 32, 32], 50),
    "nature": ([(8, 4), (4, 2), (3, 1)], [32, 64, 64], 512),
    "small": ([(2, 1), (2, 1), (2, 1)], [16, 32, 64], 64),
}


def conv_encoder(
    env: Any,
    kind: str | None = None,
    *,
    features: int | None = None,
    shared: ConvEncoder | None = None,
    detach: bool = False,
    key: NestedKey | None = None,
    group: str | None = None,
    device: torch.device | str | None = None,
) -> ConvEncoder:
    """Convolutions and one linear layer for a builder's ``encoder=``: ``[*B, channels, height, width]`` to features.

    Images are uint8 and are scaled to [0, 1] here, or floats within [0, 1]. A stack of frames may have a dimension of
    its own before the channels.

    **Which loss trains it.** One encoder given to several networks is trained by the sum of all losses. As in DrQ and
    SAC-AE, let the critic's loss alone train the convolutions:
    ``conv_encoder(env, shared=critic_encoder, detach=True)`` is the actor's, with the same convolutions, which its
    losses leave as they are, and a linear layer of its own. :class:`Detached` does the like for any encoder.

    Args:
        env: its specs give the size of the images.
        kind: ``drq``: four layers of 32 filters 3x3, the first with stride 2, then a linear layer, layer norm and tanh
            (Yarats et al., 2021, https://arxiv.org/abs/1910.01741), from 15x15 on; ``nature``: Atari's three layers
            (Mnih et al., 2015), from 36x36 on; ``small``: three layers 2x2, from 4x4 on (MiniGrid's 7x7). None:
            ``drq``, or ``small`` for images that are too small for it.
        features: size of the result; by default 50, 512, 64.
        shared: an encoder whose convolutions are used.
        detach: no gradient reaches the convolutions from here.
        key: entry of the images; by default ``observation``, of a group below its name.
        group: as in :func:`~pgkit.modules.gaussian_actor`.
        device: where it is built; by default the specs' device.

    Raises:
        UserError: images that are too small, have their channels last or are not within [0, 1]; an unknown kind.
    """
    who = agents(env, group, device=device)
    entry = who.key("observation") if key is None else key
    spec = who.observation(entry)
    _check(spec, entry)
    size = tuple(spec.shape[-2:])
    kind = kind or ("drq" if min(size) >= _least("drq") else "small")
    if kind not in _KINDS:
        raise UserError(f"kind='{kind}': choose one of {', '.join(_KINDS)}")
    if min(size) < _least(kind):
        least = {name: f"{_least(name)}x{_least(name)}" for name in _KINDS}
        fits = [f"kind='{name}' takes {least[name]}" for name in _KINDS if _least(name) <= min(size)]
        raise UserError(
            f"images of {size[0]}x{size[1]} are too small for kind='{kind}', which takes {least[kind]} and more: "
            f"{' and '.join(fits) or 'use a perceptron (nn.Flatten and modules.mlp)'}"
        )
    encoder = ConvEncoder(tuple(spec.shape), kind, features, entry, detach).to(who.device)
    if shared is not None:
        if shared.shape != encoder.shape or shared.kind != kind:
            raise UserError(
                f"shared= reads images {shared.shape} by kind='{shared.kind}', this encoder {encoder.shape} by "
                f"kind='{kind}': convolutions are shared between equal ones"
            )
        encoder.convolutions = shared.convolutions
    return encoder


def image_encoder(env: Any, device: torch.device | str | None = None) -> ConvEncoder | None:
    """Atari's encoder where the observation is an image of bytes (``small`` where that is too small), else None.

    Args:
        env: its specs say which.
        device: as in :func:`conv_encoder`.
    """
    spec = env.observation_spec_unbatched
    if "observation" not in spec.keys() or spec["observation"].ndim < 3 or spec["observation"].dtype != torch.uint8:
        return None
    least = min(spec["observation"].shape[-2:])
    return conv_encoder(env, "nature" if least >= _least("nature") else None, device=device)


class ConvEncoder(nn.Module):
    """What :func:`conv_encoder` makes."""

    def __init__(self, shape: Sequence[int], kind: str, features: int | None, key: NestedKey, detach: bool) -> None:
        super().__init__()
        layers, filters, default = _KINDS[kind]
        self.shape, self.kind, self.in_keys, self.detach = tuple(shape), kind, [key], detach
        self.features = features or default
        channels, size = prod(shape[:-2]), tuple(shape[-2:])
        self.sizes = [(channels, *size)]  # of the image and of each layer's result
        convolutions: list[nn.Module] = []
        for (kernel, stride), count in zip(layers, filters, strict=True):
            layer = nn.Conv2d(channels, count, kernel, stride)
            convolutions += [orthogonal(layer, 2**0.5), nn.ReLU()]
            channels, size = count, tuple((side - kernel) // stride + 1 for side in size)
            self.sizes.append((channels, *size))
        self.convolutions = nn.Sequential(*convolutions)
        linear = nn.Linear(prod(self.sizes[-1]), self.features)
        if kind == "drq":
            self.trunk = nn.Sequential(orthogonal(linear, 1.0), nn.LayerNorm(self.features), nn.Tanh())
        else:
            self.trunk = nn.Sequential(orthogonal(linear, 2**0.5), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        rank = len(self.shape)
        if tuple(x.shape[-rank:]) != self.shape:
            raise UserError(f"the encoder was built for images {self.shape}, these are {tuple(x.shape[-rank:])}")
        weight: Any = self.convolutions[0].weight
        if x.dtype == torch.uint8:
            images = x.to(weight.dtype) / 255
        else:
            images = x
            if not torch.compiler.is_compiling() and not ((x >= 0) & (x <= 1)).all():
                raise UserError(
                    f"float images must lie within [0, 1], these are from {float(x.min()):g} to {float(x.max()):g}: "
                    "give uint8, or divide by 255"
                )
        out = self.convolutions(images.reshape(-1, *self.sizes[0])).flatten(1)
        out = self.trunk(out.detach() if self.detach else out)
        return out.reshape(*x.shape[:-rank], self.features)


class Detached(nn.Module):
    """An encoder that the losses of this network leave as it is; other networks that read it train it.

    Args:
        encoder: one module from the observation, or from what its ``in_keys`` name, to features.
    """

    def __init__(self, encoder: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.in_keys = getattr(encoder, "in_keys", ["observation"])

    def forward(self, *entries: Tensor) -> Tensor:
        return self.encoder(*entries).detach()


def decoder(encoder: ConvEncoder) -> nn.Sequential:
    """The mirror of an encoder, features ``[B, features]`` to images ``[B, channels, height, width]``.

    SAC-AE's (Yarats et al., 2021, https://arxiv.org/abs/1910.01741): a linear layer, then a transposed convolution for
    each of the encoder's; its target is :func:`pgkit.functional.quantized_pixels`. Built where the encoder is.
    """
    layers, _, _ = _KINDS[encoder.kind]
    modules: list[nn.Module] = [
        orthogonal(nn.Linear(encoder.features, prod(encoder.sizes[-1])), 1.0),
        nn.ReLU(),
        nn.Unflatten(-1, encoder.sizes[-1]),
    ]
    for i in reversed(range(len(layers))):
        (kernel, stride), (inner, *small), (outer, *large) = layers[i], encoder.sizes[i + 1], encoder.sizes[i]
        left = [side - ((least - 1) * stride + kernel) for side, least in zip(large, small, strict=True)]
        layer = nn.ConvTranspose2d(inner, outer, kernel, stride, output_padding=left)
        modules += [orthogonal(layer, 2**0.5 if i else 1.0), *([nn.ReLU()] if i else [])]
    return nn.Sequential(*modules).to(next(encoder.parameters()).device)


def _least(kind: str) -> int:
    """The smallest side of an image that a kind of encoder takes."""
    side = 1
    for kernel, stride in reversed(_KINDS[kind][0]):
        side = (side - 1) * stride + kernel
    return side


def _check(spec: Any, key: NestedKey) -> None:
    shape = tuple(spec.shape)
    if len(shape) not in (2, 3, 4):
        raise UserError(f"'{key}' has shape {shape}, which is no image: expected (channels, height, width)")
    if len(shape) >= 3 and shape[-1] < min(shape[-3:-1]):
        raise UserError(
            f"'{key}' has shape {shape}, its channels come last: they are read first, {(shape[-1], *shape[-3:-1])}. "
            "envs.make(..., pixels=84) gives that; otherwise permute them in the environment "
            "(torchrl.envs.PermuteTransform, gymnasium.wrappers.TransformObservation)"
        )
    if spec.dtype == torch.uint8:
        return
    if not spec.dtype.is_floating_point:
        raise UserError(f"'{key}' is {spec.dtype}, images are uint8, or floats within [0, 1]")
    if not isinstance(spec, Bounded):
        return
    space: Any = spec.space
    low, high = float(space.low.min()), float(space.high.max())
    if low < 0 or high > 1:
        raise UserError(
            f"'{key}' is a float image from {low:g} to {high:g}, expected [0, 1]: leave it uint8, or divide by 255"
        )
