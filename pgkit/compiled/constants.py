"""What native code takes as constants besides its inputs, and the words for it when one of them changed."""

from __future__ import annotations

import operator
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor, nn

_KEPT = (int, float, str, FunctionType, BuiltinFunctionType, MethodType, partial, Tensor, nn.Module)
_LIBRARIES = {"torch", "tensordict", "torchrl", "pgkit"}  # their _names are their own affair
_INTERNAL = {name for name in vars(nn.Module()) if name.startswith("_")}
_MOST_ITEMS = 100  # of a list: it may be a log

Slot = tuple[str, Callable[[], Any]]  # a name, and what reads the value that is there now


class Constants:
    """What modules hold: numbers, strings, functions, tensors and modules, to be compared with later.

    These are the attributes of the modules and of their submodules, and one level further what such an attribute
    holds: the items of a list or dict, the attributes of an object, the variables around a function and the global
    numbers that it reads. What a function closes over beyond that is a constant, as in JAX. A tensor or module changed
    if it was replaced; what is written into it changes nothing here.

    Args:
        watched: modules or functions, each under what a message calls it.
        but: names of attributes that may change.
    """

    def __init__(self, watched: Mapping[str, Any], but: Collection[str] = ()) -> None:
        slots = [
            (f"in {owner} '{name}'", read)
            for owner, held in watched.items()
            for name, read in _slots_of(held)
            if name.rpartition(".")[2] not in but
        ]
        slots = [(name, read) for name, read in slots if (value := read()) is None or isinstance(value, _KEPT)]
        self._names, self._reads = [name for name, _ in slots], [read for _, read in slots]
        self._values = [read() for read in self._reads]
        self._tensors = tensors_of(watched)
        self._memory = [x.data_ptr() for x in self._tensors]

    def changed(self, memory: bool = True) -> str | None:
        """The first that is another now than it was, in words; ``memory``: new memory of a tensor counts as well."""
        now = [read() for read in self._reads]
        if not all(map(operator.is_, now, self._values)):
            for name, old, new in zip(self._names, self._values, now, strict=True):
                if not _same(old, new):
                    return f"{name} went from {_show(old)} to {_show(new)}"
        if memory and [x.data_ptr() for x in self._tensors] != self._memory:
            return "the memory of a parameter or buffer was replaced (x.data = ...)"
        return None


def tensors_of(watched: Mapping[str, Any]) -> list[Tensor]:
    """Parameters and buffers of the modules among ``watched``, each once."""
    modules = [held for held in watched.values() if isinstance(held, nn.Module)]
    tensors = [x for module in modules for x in (*module.parameters(), *module.buffers())]
    return list({id(x): x for x in tensors}.values())


def _slots_of(held: Any) -> Iterator[Slot]:
    return _of_module("", held, set()) if isinstance(held, nn.Module) else _inside("", lambda: held)


def _of_module(path: str, module: nn.Module, seen: set[int]) -> Iterator[Slot]:
    """A module's attributes, what they hold, and the same of every module among them."""
    if id(module) in seen or isinstance(module, TensorDictBase):
        return
    seen.add(id(module))
    own = vars(module)
    for table in (own, own["_parameters"], own["_buffers"], own["_modules"]):
        for key in _public(module, table):
            name, read = f"{path}.{key}".removeprefix("."), partial(table.get, key)
            yield name, read
            yield from _of_module(name, read(), seen) if isinstance(read(), nn.Module) else _inside(name, read)


def _inside(path: str, read: Callable[[], Any]) -> Iterator[Slot]:
    """What an attribute that is no module holds."""
    value, keys = read(), list[Any]()
    while isinstance(value, partial | MethodType):
        value = value.func if isinstance(value, partial) else value.__self__
        read = partial(lambda held: held, value)
    if isinstance(value, FunctionType):
        cells = zip(value.__code__.co_freevars, value.__closure__ or (), strict=True)
        yield from ((f"{path}.{name}", partial(_held, lambda cell=cell: cell, "cell_contents")) for name, cell in cells)
        numbers = [key for key in value.__code__.co_names if isinstance(value.__globals__.get(key), int | float)]
        yield from ((f"{path}: {key}", partial(value.__globals__.get, key)) for key in numbers)
    elif isinstance(value, dict):
        keys = list(value)
    elif isinstance(value, list | tuple):
        keys = list(range(min(len(value), _MOST_ITEMS)))
    elif not isinstance(value, type | Tensor | TensorDictBase | nn.Module):
        keys = _public(value, getattr(value, "__dict__", {}))
    yield from ((f"{path}.{key}", partial(_held, read, key)) for key in keys)


def _held(read: Callable[[], Any], key: Any) -> Any:
    """An item or attribute of what is there now, None if it has none."""
    value = read()
    try:
        return value[key] if isinstance(value, dict | list | tuple) else getattr(value, key, None)
    except (LookupError, TypeError, ValueError):
        return None


def _public(owner: Any, attributes: Mapping[str, Any]) -> list[str]:
    own = type(owner).__module__.split(".")[0] not in _LIBRARIES
    return [key for key in attributes if (key not in _INTERNAL if own else not key.startswith("_"))]


def _same(old: Any, new: Any) -> bool:
    if old is new or not (isinstance(old, _KEPT) or isinstance(new, _KEPT)):
        return True
    return not isinstance(old, Tensor) and not isinstance(new, Tensor) and type(old) is type(new) and bool(old == new)


def _show(value: Any) -> str:
    return f"one {type(value).__name__}" if isinstance(value, Tensor | nn.Module) else str(value)
