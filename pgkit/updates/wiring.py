"""The check of an assembled update, once, before its first step."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torch.optim import Optimizer

from pgkit.errors import UserError
from pgkit.updates.optimizers import parameters


def read_keys(loss: nn.Module, data: TensorDictBase) -> list[Any]:
    """Entries of ``data`` that the loss may read: its ``in_keys`` and its configurable keys, those present.

    ``next`` entries are for estimating advantages, so they stay out where the advantage is there.
    """
    present = set(data.keys(True, True))
    keys = list(getattr(loss, "in_keys", None) or present)
    if hasattr(loss, "tensor_keys"):
        configured = [getattr(loss.tensor_keys, field.name) for field in fields(loss.tensor_keys)]
        keys += [key for key in configured if isinstance(key, str | tuple)]
        if getattr(loss.tensor_keys, "advantage", None) in present:
            keys = [key for key in keys if not (isinstance(key, tuple) and key[0] == "next")]
    keys += [key for key in (("collector", "mask"),) if key in present]
    return [key for key in dict.fromkeys(keys) if key in present]


def check(loss: nn.Module, advantage: Any, optimizer: Optimizer, batch: TensorDictBase) -> list[str]:
    """Runs the loss once on ``batch`` and checks the chain; returns the names of the loss's entries.

    Raises:
        UserError: one line that names the key or parameter, who writes it and who reads it.
    """
    name = type(loss).__name__
    _one_owner("gamma", loss, advantage)
    _one_owner("lmbda", loss, advantage)
    with torch.random.fork_rng(devices=[]):
        try:
            out = loss(batch.copy())
        except (KeyError, ValueError, TypeError) as error:
            reason = error.args[0] if error.args else error
            source = "nothing (no advantage block)" if advantage is None else type(advantage).__name__
            present = ", ".join(f"{key} {tuple(batch[key].shape)}" for key in batch.keys(True, True))
            raise UserError(
                f"{name} cannot read its batch: {reason}. The batch has {present}; its advantage is written by {source}"
            ) from error
    losses = [key for key in out.keys() if key.startswith("loss_")]
    if not losses:
        raise UserError(f"{name} returned no entry that begins with 'loss_' (only {', '.join(out.keys())})")
    bad = [key for key in losses if out[key].numel() != 1]
    if bad:
        raise UserError(f"{name} returned '{bad[0]}' of shape {tuple(out[bad[0]].shape)}: a loss must be one number")
    _check_parameters(name, loss, optimizer, sum(out[key].sum() for key in losses))
    return [key for key in out.keys() if out[key].numel() == 1]


def _one_owner(what: str, loss: nn.Module, advantage: Any) -> None:
    mine, theirs = (
        getattr(getattr(loss, "_value_estimator", None), what, None),
        getattr(advantage, what, None),
    )
    if mine is not None and theirs is not None and float(mine) != float(theirs):
        raise UserError(
            f"two owners of {what}: {type(advantage).__name__} has {float(theirs):g}, the value estimator inside "
            f"{type(loss).__name__} has {float(mine):g}; set it in one place"
        )


def _check_parameters(name: str, loss: nn.Module, optimizer: Optimizer, total: Any) -> None:
    trained = parameters(optimizer)
    ids = {id(p) for p in trained}
    names = {id(p): key for key, p in loss.named_parameters()}
    missing = [key for key, p in loss.named_parameters() if p.requires_grad and id(p) not in ids]
    if missing:
        raise UserError(
            f"parameter '{missing[0]}' of {name} (and {len(missing) - 1} more) is in no group of the optimizer: "
            "build it from [*actor.parameters(), *critic.parameters()] or freeze the parameter (requires_grad_(False))"
        )
    grads = torch.autograd.grad(total, trained, allow_unused=True)
    unused = [names.get(id(p), f"of shape {tuple(p.shape)}") for p, g in zip(trained, grads, strict=True) if g is None]
    if unused:
        raise UserError(
            f"the optimizer holds parameter '{unused[0]}' (and {len(unused) - 1} more) that no loss_* entry of {name} "
            "depends on: was the optimizer built for another agent?"
        )
