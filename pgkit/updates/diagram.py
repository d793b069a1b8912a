"""The wiring of an assembled update as text: who writes and who reads each entry."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor, nn

from pgkit.optim import parameters
from pgkit.updates.chain import Chain, is_loss, shape, show


def diagram(update: Any, chain: Chain, step: str, batch: TensorDictBase | None = None) -> str:
    """What ``print(update)`` shows.

    Args:
        update: has ``loss`` and ``optimizer``.
        chain: the same loss with what comes before it.
        step: one line about the steps.
        batch: a batch as the loss got it, for the shapes.
    """
    loss, optimizer = update.loss, update.optimizer
    rates = ", ".join(dict.fromkeys(f"{float(group['lr']):g}" for group in optimizer.param_groups))
    minimized = [key for key in getattr(loss, "out_keys", None) or [] if is_loss(key)]
    head = {
        "data": chain.source,
        "advantage": chain.advantage and _described(chain.advantage),
        "loss": _described(loss, chain.networks()),
        "minimizes": " + ".join(map(show, minimized)),
        "optimizer": f"{type(optimizer).__name__}, lr {rates}, {_count(parameters(optimizer))} parameters",
        "step": step,
    }
    lines = [type(update).__name__, *(f"  {name:<10} {text}" for name, text in head.items() if text)]
    return "\n".join([*lines, "", *_table(chain, batch)])


def _table(chain: Chain, batch: TensorDictBase | None) -> list[str]:
    block = chain.advantage
    before, after = getattr(block, "in_keys", []), getattr(block, "out_keys", [])
    read = [key for key in chain.reads() if not (block and _is_next(key))]
    read += [key for key in map(chain.key, ("advantage", "value_target")) if key in after]
    keys = [key for key in dict.fromkeys([*read, *before, *after]) if key != "_"]
    keys.sort(key=lambda key: (key in after, _is_next(key)))
    rows = [("entry", "shape" if batch is not None else "", "written by", "read by")]
    for key in keys:
        nets = chain.readers(key)
        readers = [*([type(block).__name__] if key in before else []), *nets]
        if key in read and not nets:
            readers.append(chain.name)
        x = None if batch is None else batch.get(key, None)
        rows.append((show(key), shape(x) if isinstance(x, Tensor) else "", chain.writer(key), ", ".join(readers)))
    columns = [i for i in range(4) if rows[0][i]]
    widths = {i: max(len(row[i]) for row in rows) for i in columns}
    return ["  " + "  ".join(f"{row[i]:<{widths[i]}}" for i in columns).rstrip() for row in rows]


def _is_next(key: Any) -> bool:
    return not isinstance(key, str) and key[0] == "next"


def _described(block: Any, networks: Iterable[str] = ()) -> str:
    owners = (block, getattr(block, "_value_estimator", None))
    values = {name: next(filter(None, (getattr(o, name, None) for o in owners)), None) for name in ("gamma", "lmbda")}
    owned = [f"{name} {float(value):g}" for name, value in values.items() if value is not None]
    sizes = {name: _count(getattr(block, f"{name}_params").values(True, True)) for name in networks}
    return ", ".join([type(block).__name__, *owned, *(f"{name} ({size} parameters)" for name, size in sizes.items())])


def _count(tensors: Any) -> str:
    return f"{sum(x.numel() for x in tensors if isinstance(x, nn.Parameter)):,}"
