"""Encoders of observations with several entries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn


def dict_encoder(encoders: Mapping[NestedKey, nn.Module]) -> DictEncoder:
    """One encoder for each entry of the observation, their features ``[*B, f_i]`` side by side.

    For environments whose observation has several entries: ``envs.make(..., flatten=False)`` or TorchRL's own.

    Args:
        encoders: entry to a module from ``[*B, *shape]`` to ``[*B, features]``.
    """
    return DictEncoder(encoders)


class DictEncoder(nn.Module):
    """What :func:`dict_encoder` makes: called with one tensor for each of its ``in_keys``."""

    def __init__(self, encoders: Mapping[NestedKey, nn.Module]) -> None:
        super().__init__()
        self.in_keys: list[Any] = list(encoders)
        self.encoders = nn.ModuleList(encoders.values())

    def forward(self, *entries: Tensor) -> Tensor:
        images = [x.dtype is torch.uint8 and x.ndim > 2 for x in entries]
        numbers = [x if x.is_floating_point() or image else x.float() for x, image in zip(entries, images, strict=True)]
        return torch.cat([encoder(x) for encoder, x in zip(self.encoders, numbers, strict=True)], -1)
