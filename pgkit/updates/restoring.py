"""Loading a loss's state, of the same shapes only."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn


def load(module: nn.Module, state: dict[str, Any]) -> None:
    """``module.load_state_dict(state)``; TensorDict's parameters would take tensors of other shapes, broadcast.

    Raises:
        ValueError: a tensor has another shape than the module's.
    """
    own = module.state_dict()
    for name in [name for name, x in own.items() if torch.is_tensor(x) and torch.is_tensor(state.get(name))]:
        if own[name].shape != state[name].shape:
            raise ValueError(f"{name} is {tuple(state[name].shape)} there and {tuple(own[name].shape)} here")
    module.load_state_dict(state)
