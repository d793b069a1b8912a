"""What recorded code holds besides its inputs: numbers, functions, tensors and modules, as they were then."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from functools import partial
from types import CellType, FunctionType, MethodType
from typing import Any, Protocol

from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

_KEPT = (int, float, str, FunctionType, MethodType, partial, Tensor, nn.Module)
_LIBRARIES = {"torch", "tensordict", "torchrl", "numpy", "builtins"}
_MOST_ITEMS = 1_000  # of a list: it may be a log
_TABLES = ("_parameters", "_buffers", "_modules")
_INTERNAL = {name for name in vars(nn.Module()) if name.startswith("_")}


class _Holder(Protocol):
    def get(self, key: Any, /) -> Any: ...


class _Closure:
    """The variables of the functions around a function, by name."""

    def __init__(self, function: FunctionType) -> None:
        cells = function.__closure__ or ()
        self.cells: dict[str, CellType] = dict(zip(function.__code__.co_freevars, cells, strict=True))

    def get(self, key: str, /) -> Any:
        return self.cells[key].cell_contents


class _Items:
    """The items of a list, by position."""

    def __init__(self, items: list[Any] | tuple[Any, ...]) -> None:
        self.items = items

    def get(self, key: int, /) -> Any:
        return self.items[key] if key < len(self.items) else None


class Constants:
    """The numbers, strings, functions, tensors and modules that a module holds, and those that they hold in turn.

    They are searched in attributes, lists and dicts; of a function in the functions around it, with the global numbers
    that it reads. A tensor or module is another if it was replaced; what is written into it changes nothing here.
    Environments are left out.
    """

    def __init__(self, module: nn.Module) -> None:
        held = list(_slots("", module, set()))
        self._names, self._slots = [name for name, _, _ in held], [(holder, key) for _, holder, key in held]
        self._values = self._read()
        tensors = [*module.parameters(), *module.buffers(), *(x for x in self._values if isinstance(x, Tensor))]
        self._tensors = list({id(x): x for x in tensors}.values())
        self._memory = [x.data_ptr() for x in self._tensors]

    def _read(self) -> list[Any]:
        return [holder.get(key) for holder, key in self._slots]

    def changed(self, memory: bool = True) -> str | None:
        """The first that is another now than it was, in words; ``memory``: new memory of a tensor counts as well."""
        now = self._read()
        if not all(map(operator.is_, now, self._values)):
            for name, old, new in zip(self._names, self._values, now, strict=True):
                if not _same(old, new):
                    return f"'{name}' went from {_show(old)} to {_show(new)}"
        if memory and [x.data_ptr() for x in self._tensors] != self._memory:
            return "the memory of a parameter or buffer was replaced (x.data = ...)"
        return None


def _same(old: Any, new: Any) -> bool:
    if old is new or not (isinstance(old, _KEPT) or isinstance(new, _KEPT)):
        return True
    return not isinstance(old, Tensor) and not isinstance(new, Tensor) and type(old) is type(new) and bool(old == new)


def _show(value: Any) -> str:
    return f"one {type(value).__name__}" if isinstance(value, Tensor | nn.Module) else str(value)


def _slots(name: str, owner: Any, seen: set[int]) -> Iterator[tuple[str, _Holder, Any]]:
    """Name, holder and key of whatever ``owner`` holds that is kept, and of what such things hold."""
    if id(owner) in seen or isinstance(owner, type | Tensor | TensorDictBase | EnvBase):
        return
    seen.add(id(owner))
    holder: Any
    keys: Any
    library = type(owner).__module__.split(".")[0]
    if isinstance(owner, MethodType | partial):
        parts = [owner.__self__] if isinstance(owner, MethodType) else [owner.func, owner.args, owner.keywords]
        for part in parts:
            yield from _slots(name, part, seen)
        return
    if isinstance(owner, FunctionType):
        holder = _Closure(owner)
        keys = list(holder.cells)
        for key in owner.__code__.co_names:  # what is global is not searched further: it may be all of torch
            if isinstance(owner.__globals__.get(key), int | float):
                yield f"{name}: {key}", owner.__globals__, key
    elif isinstance(owner, dict):
        holder, keys = owner, list(owner)
    elif isinstance(owner, list | tuple):
        holder, keys = _Items(owner), range(min(len(owner), _MOST_ITEMS))
    elif isinstance(owner, nn.Module) or library not in _LIBRARIES:
        holder = getattr(owner, "__dict__", {})
        hidden = _INTERNAL if library not in {*_LIBRARIES, "pgkit"} else {key for key in holder if key.startswith("_")}
        keys = [key for key in holder if key not in hidden]
        for table in (holder.get(table, {}) for table in _TABLES if isinstance(owner, nn.Module)):
            for key, value in table.items():
                yield f"{name}.{key}".removeprefix("."), table, key
                yield from _slots(f"{name}.{key}".removeprefix("."), value, seen)
    else:
        return
    for key in keys:
        value = holder.get(key)
        path = f"{name}.{key}".removeprefix(".")
        if value is None or isinstance(value, _KEPT):
            yield path, holder, key
        yield from _slots(path, value, seen)
