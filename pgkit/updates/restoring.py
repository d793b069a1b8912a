"""State put back: loaded, of the same shapes only, or undone after a trial."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn


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


def undone(tensors: Iterable[Tensor], function: Callable[[], Any]) -> Any:
    """The function's result; what it did to these tensors and to the random generator is undone."""
    before = [(tensor, tensor.detach().clone()) for tensor in tensors]
    try:
        with torch.random.fork_rng(devices=[]):
            return function()
    finally:
        with torch.no_grad():
            for tensor, value in before:
                tensor.copy_(value)
