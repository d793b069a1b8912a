"""Tensors of any types as one array of bytes: one message, whatever their number."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

_ALIGNED = 64  # bytes; a view of another type must begin at a multiple of its size


class Layout:
    """Where tensors like those of ``like`` lie in an array of :attr:`size` bytes, one behind the other."""

    def __init__(self, like: Iterable[Tensor]) -> None:
        self._parts, self.size = [], 0
        for x in like:
            bytes_of_x = x.numel() * x.element_size()
            self._parts.append((self.size, bytes_of_x, x.dtype, x.shape))
            self.size += -(-bytes_of_x // _ALIGNED) * _ALIGNED

    def views(self, block: Tensor) -> list[Tensor]:
        """The tensors in a uint8 block, without a copy."""
        return [block[at : at + length].view(dtype).view(shape) for at, length, dtype, shape in self._parts]

    def pack(self, tensors: Iterable[Tensor]) -> np.ndarray:
        """The tensors as one array."""
        block = torch.zeros(self.size, dtype=torch.uint8)
        for mine, x in zip(self.views(block), tensors, strict=True):
            mine.copy_(x)
        return block.numpy()

    def unpack(self, array: np.ndarray) -> list[Tensor]:
        """The tensors in an array that Ray may have made read-only: copy before you write."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            return self.views(torch.from_numpy(array))
