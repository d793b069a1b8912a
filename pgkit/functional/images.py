"""Images: shifts for augmentation, and the target of a decoder."""

from __future__ import annotations

import torch
from torch import Tensor


def shift_images(x: Tensor, down: Tensor, right: Tensor, pad: int) -> Tensor:
    """Each image moved by whole pixels; its border is repeated where it moved away from.

    The random shift of DrQ (Kostrikov et al., 2021, https://arxiv.org/abs/2004.13649): pad by repeating the border,
    then cut out a window. One gather for all images.

    Args:
        x: ``[B, channels, height, width]``, of any type.
        down, right: int64 ``[B]``, from ``-pad`` to ``pad``.
        pad: the furthest shift.

    Returns:
        As ``x``.
    """
    rows, columns = (torch.arange(-pad, size + pad, device=x.device).clamp(0, size - 1) for size in x.shape[-2:])
    padded = x.index_select(-2, rows).index_select(-1, columns)
    windows = padded.unfold(-2, x.shape[-2], 1).unfold(-2, x.shape[-1], 1)  # [B, C, 2 pad + 1, 2 pad + 1, H, W]
    return windows[torch.arange(len(x), device=x.device), :, pad - down, pad - right]


def quantized_pixels(x: Tensor, bits: int = 5) -> Tensor:
    r"""The target that a decoder reconstructs: pixels of fewer bits with noise in place of the others.

    .. math::
        \frac{\lfloor x / 2^{8 - b} \rfloor + u}{2^b} - \frac12, \quad u \sim U[0, 1)

    SAC-AE's (Yarats et al., 2021, https://arxiv.org/abs/1910.01741), after Glow.

    Args:
        x: uint8, any shape.
        bits: :math:`b`, from 1 to 8.

    Returns:
        float32 in [-0.5, 0.5), of the same shape.

    Raises:
        TypeError: ``x`` is not uint8.
    """
    if x.dtype != torch.uint8:
        raise TypeError(f"quantized_pixels takes uint8 images, not {x.dtype}")
    levels = (x // 2 ** (8 - bits)).float()
    return (levels + torch.rand_like(levels)) / 2**bits - 0.5
