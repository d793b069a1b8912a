"""The check of who owns what: gamma and lambda have one owner, every trained parameter has one optimizer."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from pgkit.errors import UserError
from pgkit.optim import parameters
from pgkit.updates.chain import Chain


def check_settings(chain: Chain, others: dict[str, Any]) -> None:
    """``gamma`` and ``lmbda`` of the loss, of the advantage block and of ``others`` (by name) must not disagree."""
    estimator = getattr(chain.loss, "_value_estimator", None)
    holders = {
        f"the value estimator inside {chain.name}": estimator,
        type(chain.advantage).__name__: chain.advantage,
        **others,
    }
    if hasattr(chain.loss, "gamma"):
        holders = {chain.name: chain.loss, **holders}
    for what in ("gamma", "lmbda"):
        values = {name: getattr(owner, what, None) for name, owner in holders.items()}
        found = {name: float(value) for name, value in values.items() if value is not None}
        if len(set(round(value, 6) for value in found.values())) > 1:
            said = ", ".join(f"{name} has {value:g}" for name, value in found.items())
            raise UserError(f"two owners of {what}: {said}; set it in one place, or to the same value in both")


def check_parameters(chain: Chain, optimizer: Optimizer, total: Tensor) -> None:
    """Every trainable parameter is in the optimizer, and ``total`` depends on every parameter of the optimizer."""
    trained = parameters(optimizer)
    ids, names = {id(p) for p in trained}, {id(p): key for key, p in chain.loss.named_parameters()}

    def called(p: Tensor) -> str:
        return f"'{names[id(p)]}'" if id(p) in names else f"of shape {tuple(p.shape)}"

    if len(ids) < len(trained):
        twice = next(p for p in trained if sum(p is other for other in trained) > 1)
        raise UserError(
            f"the optimizer holds parameter {called(twice)} twice and would step it twice: build it from "
            "loss.parameters(), which has every one once"
        )
    held = {chain.name: chain.loss}
    if isinstance(chain.advantage, nn.Module):
        held[type(chain.advantage).__name__] = chain.advantage
    for owner, module in held.items():
        missing = [key for key, p in module.named_parameters() if p.requires_grad and id(p) not in ids]
        if missing and module is chain.loss:
            raise UserError(
                f"parameter '{missing[0]}' of {owner}{_more(missing)} is in no group of the optimizer: "
                "build it from loss.parameters() or freeze the parameter "
                "(requires_grad_(False))"
            )
        if missing:
            raise UserError(
                f"parameter '{missing[0]}' of {owner}{_more(missing)} is trained by nothing: it is not one of "
                f"{chain.name}'s and in no group of the optimizer; give both the same critic, or freeze this one "
                "(requires_grad_(False))"
            )
    frozen = [p for p in trained if not p.requires_grad]
    if frozen:
        raise UserError(
            f"the optimizer holds parameter {called(frozen[0])}{_more(frozen)}, which is frozen (requires_grad is "
            "False): leave it out of the optimizer ([p for p in loss.parameters() if p.requires_grad]), or "
            "requires_grad_(True)"
        )
    grads = torch.autograd.grad(total, trained, allow_unused=True)
    unused = [p for p, grad in zip(trained, grads, strict=True) if grad is None]
    if unused:
        raise UserError(
            f"the optimizer holds parameter {called(unused[0])}{_more(unused)} that no loss_* entry of {chain.name} "
            "depends on: is the coefficient of its term 0, or was the optimizer built for another agent?"
        )


def _more(items: list[Any]) -> str:
    return f" (and {len(items) - 1} more)" if len(items) > 1 else ""
