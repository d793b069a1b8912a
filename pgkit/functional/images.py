"""Images: shifts for augmentation, and the target of a decoder."""

from __future__ import annotations

import torch
from torch import Tensor


def shift_images(x: Tensor, down: Tensor, right: Tensor) -> Tensor:
    """Each image moved by whole pixels; its border is repeated where it moved away from.

    The random shift of DrQ (Kostrikov et al., 2021, https://arxiv.org/abs/2004.13649): pad by repeating the border,
    then cut out a window. Whole rows are copied first, then a gather moves them sideways: both fast on a CPU.

    Args:
        x: ``[B, channels, height, width]``, of any type.
        down, right: by how many pixels, int64 ``[B]``.

    Returns:
        As ``x``.
    """
    images, channels, height, width = x.shape
    row = (torch.arange(height, device=x.device) - down.unsqueeze(-1)).clamp(0, height - 1)
    column = (torch.arange(width, device=x.device) - right.unsqueeze(-1)).clamp(0, width - 1)
    first = torch.arange(images * channels, device=x.device).reshape(images, channels, 1) * height
    rows = x.reshape(-1, width).index_select(0, (first + row.unsqueeze(1)).flatten()).reshape(x.shape)
    return rows.gather(-1, column[:, None, None].expand(x.shape))


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
