"""Augmentations: ``batch -> batch``, for an update's ``augment=``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from pgkit.functional import shift_images


def random_shift(pad: int = 4, keys: Sequence[NestedKey] = ("observation", ("next", "observation"))) -> RandomShift:
    """Every image of a batch moved by up to ``pad`` pixels each way, with a draw of its own (DrQ's augmentation).

    Kostrikov et al., 2021 (https://arxiv.org/abs/2004.13649). All frames and channels of an image move together; uint8
    stays uint8.

    Args:
        pad: the furthest shift.
        keys: entries of images ``[*B, ..., height, width]``, each with draws of its own; those that a batch lacks are
            left out.
    """
    return RandomShift(pad, keys)


class RandomShift:
    """What :func:`random_shift` makes."""

    def __init__(self, pad: int, keys: Sequence[NestedKey]) -> None:
        self.pad, self.keys = pad, tuple(keys)

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        out = batch.copy()
        for key in self.keys:
            x = batch.get(key, None)
            if x is not None:
                images = x.reshape(batch.numel(), -1, *x.shape[-2:])
                down, right = torch.randint(-self.pad, self.pad + 1, (2, len(images)), device=x.device)
                out.set(key, shift_images(images, down, right).reshape(x.shape))
        return out

    def __repr__(self) -> str:
        return f"random_shift(pad={self.pad})"
