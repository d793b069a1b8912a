"""Plain numbers and functions of a loss: a compiled step holds tensors, and these as they were when it was recorded."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from types import CellType, FunctionType, MethodType
from typing import Any, Protocol

from tensordict import TensorDictBase
from torch import Tensor, nn

_CONSTANT = (int, float, FunctionType, MethodType, partial)
_LIBRARIES = {"torch", "tensordict", "torchrl", "numpy", "builtins"}


class _Holder(Protocol):
    def get(self, key: str, /) -> Any: ...


class _Closure:
    """The variables of the functions around a function, by name."""

    def __init__(self, function: FunctionType) -> None:
        cells = function.__closure__ or ()
        self.cells: dict[str, CellType] = dict(zip(function.__code__.co_freevars, cells, strict=True))

    def get(self, key: str, /) -> Any:
        return self.cells[key].cell_contents


class Constants:
    """The numbers and functions among the attributes of a loss, of its modules and of the objects that these hold.

    Of a function they are those of the functions around it, and global numbers. Attributes whose names begin with an
    underscore are not looked at.
    """

    def __init__(self, loss: nn.Module) -> None:
        held = list(_slots("", loss, set()))
        self._names, self._slots = [name for name, _, _ in held], [(holder, key) for _, holder, key in held]
        self._values = self._read()

    def _read(self) -> list[Any]:
        values = [holder.get(key) for holder, key in self._slots]
        return [value if isinstance(value, _CONSTANT) else None for value in values]

    def changed(self) -> str | None:
        """The first that is another now than it was, in words."""
        now = self._read()
        if now == self._values:
            return None
        was = zip(self._names, self._values, now, strict=True)
        name, old, new = next((name, old, new) for name, old, new in was if old != new)
        return f"'{name}' went from {old} to {new}"


def _slots(name: str, owner: Any, seen: set[int]) -> Iterator[tuple[str, _Holder, str]]:
    """Name, holder and key of whatever ``owner`` holds that may be a constant, and of what such things hold."""
    if id(owner) in seen or isinstance(owner, type | Tensor | TensorDictBase):
        return
    seen.add(id(owner))
    holder: Any
    if isinstance(owner, MethodType | partial):
        yield from _slots(name, owner.__self__ if isinstance(owner, MethodType) else owner.func, seen)
        return
    if isinstance(owner, FunctionType):
        holder = _Closure(owner)
        keys = list(holder.cells)
        for key in owner.__code__.co_names:  # what is global is not searched further: it may be all of torch
            if isinstance(owner.__globals__.get(key), int | float):
                yield f"{name}: {key}", owner.__globals__, key
    elif isinstance(owner, nn.Module) or type(owner).__module__.split(".")[0] not in _LIBRARIES:
        holder = getattr(owner, "__dict__", {})
        keys = [key for key in holder if not key.startswith("_")]
        for key, module in getattr(owner, "_modules", {}).items():
            yield from _slots(f"{name}.{key}".removeprefix("."), module, seen)
    else:
        return
    for key in keys:
        value = holder.get(key)
        path = f"{name}.{key}".removeprefix(".")
        if value is None or isinstance(value, _CONSTANT):
            yield path, holder, key
        yield from _slots(path, value, seen)
