"""What an update saves and loads of its parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from pgkit.compiled import load_matmul_state, matmul_state


def save(parts: Mapping[str, Any]) -> dict[str, Any]:
    """The state of every part, empty for None, and which kernels make the products, for the same bits again."""
    states = {name: {} if part is None else part.state_dict() for name, part in parts.items()}
    return states | {"products": matmul_state()}


def load(parts: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    """Loads what :func:`save` gave; TensorDict's parameters would take tensors of other shapes, broadcast.

    Raises:
        ValueError: a tensor has another shape than the module's.
    """
    for name, part in parts.items():
        own = part.state_dict() if isinstance(part, nn.Module) else {}
        for key in [key for key, x in own.items() if torch.is_tensor(x) and torch.is_tensor(state[name].get(key))]:
            there, here = tuple(state[name][key].shape), tuple(own[key].shape)
            if there != here:
                raise ValueError(f"{key} is {there} there and {here} here")
        if part is not None:
            part.load_state_dict(state[name])
    load_matmul_state(state.get("products", {}), setting=False)
