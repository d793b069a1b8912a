"""Every tensor and number that an object holds, by the path that leads to it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias

from torch import Tensor

Slot: TypeAlias = tuple[str, Any, Any, Any]  # path, the object, list or dict that holds it, its name there, its value


def walk(owner: Any, own: set[str], path: str = "", seen: set[int] | None = None) -> Iterator[Slot]:
    """Every tensor and number that an object holds, and what it holds of the packages ``own``, lists and dicts too."""
    seen = set() if seen is None else seen
    seen.add(id(owner))
    if isinstance(owner, list | tuple):
        items = list(enumerate(owner))
    else:
        items = list((owner if isinstance(owner, dict) else vars(owner)).items())
    for place, (name, x) in enumerate(items):
        here = f"{path}.{name if isinstance(name, str) else place}"  # a dict's keys may be entities
        if isinstance(x, Tensor | bool | int | float):
            if not isinstance(owner, tuple):
                yield here, owner, name, x
        elif id(x) not in seen and (isinstance(x, dict | list | tuple) or type(x).__module__.partition(".")[0] in own):
            yield from walk(x, own, here, seen)


def put(slot: Slot, value: Any) -> None:
    """Gives a slot another value; a tensor keeps its device, and its memory, which others may share."""
    _, holder, name, now = slot
    if isinstance(now, Tensor) and isinstance(value, Tensor):
        value = value.to(now.device)
        if now.shape == value.shape and _is_dense(now):
            now.copy_(value)
            return
    if isinstance(holder, dict | list):
        holder[name] = value
    else:
        vars(holder)[name] = value


def _is_dense(x: Tensor) -> bool:
    """Whether no two elements share memory."""
    return all(size == 1 or stride > 0 for size, stride in zip(x.shape, x.stride(), strict=True))
