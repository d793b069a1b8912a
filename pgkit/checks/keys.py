"""Keys and shapes as a message shows them."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor


def following(key: Any) -> tuple[str, ...]:
    """The key of the same entry one step on."""
    return ("next", *group(key), last(key))


def group(key: Any) -> tuple[str, ...]:
    """What an entry lies in: ``("agents",)`` for ``("agents", "reward")``, nothing for ``reward``."""
    return () if isinstance(key, str) else tuple(key[:-1])


def last(key: Any) -> str:
    """An entry's own name, without what it lies in."""
    return key if isinstance(key, str) else key[-1]


def is_next(key: Any) -> bool:
    """Whether an entry is one of the next state's."""
    return group(key)[:1] == ("next",)


def rows(batch: TensorDictBase, key: Any) -> tuple[int, ...]:
    """Batch size of what an entry lies in: ``(B,)``, in a group of agents ``(B, A)``."""
    return tuple((batch.get(group(key)) if group(key) else batch).batch_size)


def show(key: Any) -> str:
    """A key as a user writes it: ``observation``, or ``next.reward``."""
    return ".".join([*group(key), last(key)])


def shape(x: Tensor) -> str:
    """A shape as ``(64, 1)``."""
    return str(tuple(x.shape))


def kind(x: Tensor) -> str:
    """A type as ``float32``."""
    return str(x.dtype).removeprefix("torch.")


def is_loss(key: Any) -> bool:
    """Whether an entry of a loss's result is minimized: ``loss_...``, or TorchRL's ``loss`` where it has but one."""
    return isinstance(key, str) and (key == "loss" or key.startswith("loss_"))
