"""The check of who owns what: gamma and lambda have one owner, every trained parameter has one optimizer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from pgkit.checks.view import LossView, setting
from pgkit.errors import UserError
from pgkit.optim import parameters


def check_discounts(view: LossView, others: Mapping[str, Any]) -> None:
    """``gamma`` and ``lmbda`` of the loss, of the advantage block and of ``others`` (by name) must not disagree."""
    holders = {
        view.name: view.loss,
        f"the value estimator inside {view.name}": view.estimator,
        view.advantage_name: view.advantage,
        **others,
    }
    for what in ("gamma", "lmbda"):
        values = {name: setting(owner, what) for name, owner in holders.items()}
        found = {name: value for name, value in values.items() if value is not None}
        if len(set(round(value, 6) for value in found.values())) > 1:
            said = ", ".join(f"{name} has {value:g}" for name, value in found.items())
            raise UserError(f"two owners of {what}: {said}; set it in one place, or to the same value in both")


def check_parameters(view: LossView, optimizer: Optimizer, total: Tensor) -> None:
    """Every trainable parameter is in the optimizer, and ``total`` depends on every parameter of the optimizer."""
    trained = parameters(optimizer)
    ids, names = {id(p) for p in trained}, {id(p): f"'{key}'" for key, p in view.loss.named_parameters()}

    def called(some: list[Tensor]) -> str:
        return f"parameter {names.get(id(some[0]), f'of shape {tuple(some[0].shape)}')}{_more(some)}"

    if len(ids) < len(trained):
        twice = next(p for p in trained if sum(p is other for other in trained) > 1)
        raise UserError(
            f"the optimizer holds {called([twice])} twice and would step it twice: build it from loss.parameters(), "
            "which has every one once"
        )
    _check_trained(view, ids)
    if frozen := [p for p in trained if not p.requires_grad]:
        raise UserError(
            f"the optimizer holds {called(frozen)}, which is frozen (requires_grad is False): leave it out of the "
            "optimizer ([p for p in loss.parameters() if p.requires_grad]), or requires_grad_(True)"
        )
    grads = torch.autograd.grad(total, trained, allow_unused=True)
    if unused := [p for p, grad in zip(trained, grads, strict=True) if grad is None]:
        raise UserError(
            f"the optimizer holds {called(unused)} that no loss_* entry of {view.name} depends on: is the coefficient "
            "of its term 0, or was the optimizer built for another agent?"
        )


def _check_trained(view: LossView, ids: set[int]) -> None:
    """No parameter of the loss or of the advantage block is left out by mistake."""
    missing = [name for name, p in view.loss.named_parameters() if p.requires_grad and id(p) not in ids]
    if missing:
        raise UserError(
            f"parameter '{missing[0]}' of {view.name}{_more(missing)} is in no group of the optimizer: build it from "
            "loss.parameters() or freeze the parameter (requires_grad_(False))"
        )
    if not isinstance(view.advantage, nn.Module):
        return
    missing = [name for name, p in view.advantage.named_parameters() if p.requires_grad and id(p) not in ids]
    if missing:
        raise UserError(
            f"parameter '{missing[0]}' of {view.advantage_name}{_more(missing)} is trained by nothing: it is not one "
            f"of {view.name}'s and in no group of the optimizer; give both the same critic, or freeze this one "
            "(requires_grad_(False))"
        )


def _more(items: list[Any]) -> str:
    return f" (and {len(items) - 1} more)" if len(items) > 1 else ""
