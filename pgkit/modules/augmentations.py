"""Augmentations: ``batch -> batch``, for an update's ``augment=``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from pgkit.errors import check_whole_number
from pgkit.functional import shift_images


def random_shift(
    pad: int = 4,
    keys: Sequence[NestedKey] = ("observation", ("next", "observation")),
    copies: int | None = None,
) -> RandomShift:
    """Every image of a batch moved by up to ``pad`` pixels each way, with a draw of its own (DrQ's augmentation).

    Kostrikov et al., 2021 (https://arxiv.org/abs/2004.13649). All frames and channels of an image move together; uint8
    stays uint8.

    Args:
        pad: the furthest shift.
        keys: entries of images ``[*B, ..., height, width]``, each with draws of its own; those that a batch lacks are
            left out.
        copies: a batch ``[*B]`` becomes ``[copies, *B]``, each copy with draws of its own: for a loss with
            ``augmented=True``, which averages targets and values over them. None: it stays ``[*B]``.

    Raises:
        UserError: ``pad`` is below 0, or ``copies`` below 1.
    """
    check_whole_number(0, pad=pad)
    check_whole_number(1, copies=copies)
    return RandomShift(pad, keys, copies)


class RandomShift:
    """What :func:`random_shift` makes."""

    def __init__(self, pad: int, keys: Sequence[NestedKey], copies: int | None) -> None:
        self.pad, self.keys, self.copies = pad, tuple(keys), copies

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        out = batch.copy() if self.copies is None else batch.expand(self.copies, *batch.batch_size)
        for key in self.keys:
            x = out.get(key, None)
            if x is not None:
                images = x.reshape(out.numel(), -1, *x.shape[-2:])
                down, right = torch.randint(-self.pad, self.pad + 1, (2, len(images)), device=x.device)
                out.set(key, shift_images(images, down, right).reshape(x.shape))
        return out

    def __repr__(self) -> str:
        return f"random_shift(pad={self.pad}{'' if self.copies is None else f', copies={self.copies}'})"
