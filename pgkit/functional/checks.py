"""Shape checks that refuse to broadcast."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def same_shape(**tensors: Tensor) -> None:
    """Raises ``ValueError`` unless all tensors have one shape: ``(B,)`` against ``(B, 1)`` never broadcasts.

    Args:
        **tensors: the tensors, by the names the message will use.
    """
    (first, expected), *others = tensors.items()
    for name, tensor in others:
        if tensor.shape != expected.shape:
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)} but {first} has shape {tuple(expected.shape)}: "
                "they must be equal (nothing is broadcast here; unsqueeze(-1) or squeeze(-1) one of them)"
            )


def is_flag(**tensors: Tensor) -> None:
    """Raises ``TypeError`` unless all tensors are boolean."""
    for name, tensor in tensors.items():
        if tensor.dtype != torch.bool:
            raise TypeError(f"{name} must be boolean, not {tensor.dtype}")


def listed(keys: Any) -> list[Any]:
    """The keys of a setting that may be one key, or several in a list: the parts of a composite action."""
    return keys if isinstance(keys, list) else [keys]
