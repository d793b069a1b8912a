"""The wiring of an assembled update as text: who writes and who reads each entry."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer

from pgkit.checks.keys import is_loss, is_next, shape, show
from pgkit.checks.view import LossView, keys_of, name_of, setting
from pgkit.optim import parameters


def diagram(
    update: object, view: LossView, optimizer: Optimizer | None, step: str, batch: TensorDictBase | None
) -> str:
    """What ``print(update)`` shows.

    Args:
        update: whose diagram it is.
        view: its loss with what comes before it.
        optimizer: its optimizer, if it has one.
        step: one line about the steps.
        batch: a batch as the loss got it, for the shapes; None before the first.
    """
    networks = {name: params.values(True, True) for name, (_, params) in view.networks().items()}
    sizes = [f"{name} ({_count(tensors)} parameters)" for name, tensors in networks.items()]
    head = {
        "data": view.source,
        "advantage": "" if view.advantage is None else ", ".join([view.advantage_name, *_discounts(view.advantage)]),
        "loss": ", ".join([view.name, *(_discounts(view.loss) or _discounts(view.estimator)), *sizes]),
        "minimizes": " + ".join(show(key) for key in view.out_keys if is_loss(key)),
        "optimizer": "" if optimizer is None else _optimizer(optimizer),
        "step": step,
    }
    lines = [name_of(update), *(f"  {name:<10} {text}" for name, text in head.items() if text)]
    return "\n".join([*lines, "", *_table(view, batch)])


def _table(view: LossView, batch: TensorDictBase | None) -> list[str]:
    before, after = keys_of(view.advantage, "in_keys"), view.estimates
    read = [key for key in view.reads() if view.advantage is None or not is_next(key)]
    read += [key for key in map(view.key, ("advantage", "value_target")) if key in after]
    keys = [key for key in dict.fromkeys([*read, *before, *after]) if key != "_"]
    keys.sort(key=lambda key: (key in after, is_next(key)))
    rows = [("entry", "shape" if batch is not None else "", "written by", "read by")]
    for key in keys:
        readers = [view.advantage_name] if key in before else []
        if key in read or view.readers(key):
            readers += view.readers(key) or [view.name]
        x = None if batch is None else batch.get(key, None)
        rows.append((show(key), shape(x) if isinstance(x, Tensor) else "", view.writer(key), ", ".join(readers)))
    columns = [i for i in range(4) if rows[0][i]]
    widths = {i: max(len(row[i]) for row in rows) for i in columns}
    return ["  " + "  ".join(f"{row[i]:<{widths[i]}}" for i in columns).rstrip() for row in rows]


def _discounts(owner: Any) -> list[str]:
    values = {name: setting(owner, name) for name in ("gamma", "lmbda")}
    return [f"{name} {value:g}" for name, value in values.items() if value is not None]


def _optimizer(optimizer: Optimizer) -> str:
    rates = ", ".join(dict.fromkeys(f"{float(group['lr']):g}" for group in optimizer.param_groups))
    return f"{name_of(optimizer)}, lr {rates}, {_count(parameters(optimizer))} parameters"


def _count(tensors: Any) -> str:
    return f"{sum(x.numel() for x in tensors if isinstance(x, nn.Parameter)):,}"
