"""What goes to processes on other machines and comes back: functions, and batches as arrays."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase


def shipped(function: Callable[..., Any]) -> bytes:
    """A function for processes on other machines: with its whole module where that is no installed one."""
    import cloudpickle

    inner = function
    while isinstance(inner, partial):
        inner = inner.func
    module = sys.modules[inner.__module__]
    own = module.__name__ != "__main__" and not module.__name__.startswith("pgkit.")
    if not own:
        return cloudpickle.dumps(function)
    cloudpickle.register_pickle_by_value(module)
    try:
        return cloudpickle.dumps(function)
    finally:
        cloudpickle.unregister_pickle_by_value(module)


def packed(data: TensorDictBase) -> dict[str, Any]:
    """Data as arrays, which Ray moves without a copy."""
    entries = {key: x.contiguous().cpu().numpy() for key, x in data.items(True, True)}
    return {"entries": entries, "batch": tuple(data.batch_size)}


def unpacked(message: Mapping[str, Any], device: torch.device | None = None) -> TensorDictBase:
    """What :func:`packed` was given, in memory of its own."""
    data = TensorDict({}, batch_size=message["batch"])
    for key, x in message["entries"].items():
        data.set(key, torch.tensor(x, device=device))
    return data
