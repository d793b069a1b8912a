"""The check of an assembled update, once, before its first step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torch.optim import Optimizer

from pgkit.compiled import undone
from pgkit.errors import UserError
from pgkit.updates import entries, owners
from pgkit.updates.chain import Chain, is_loss
from pgkit.updates.tables import NoTables, TableError


def read_keys(loss: nn.Module, data: TensorDictBase) -> list[Any]:
    """Entries of ``data`` that the loss may read: its ``in_keys`` and its configurable keys, those present.

    Where the advantage is there, the ``next`` entries that TorchRL's own losses would estimate it from stay out.
    """
    present = set(data.keys(True, True))
    keys = list(getattr(loss, "in_keys", None) or present)
    if hasattr(loss, "tensor_keys"):
        configured = [getattr(loss.tensor_keys, field.name) for field in fields(loss.tensor_keys)]
        keys += [key for key in configured if isinstance(key, str | tuple)]
        torchrl = type(loss).__module__.startswith("torchrl.")
        if torchrl and getattr(loss.tensor_keys, "advantage", None) in present:
            keys = [key for key in keys if not (isinstance(key, tuple) and key[0] == "next")]
    keys += [("collector", "mask"), "steps_to_next_obs"]  # read by TorchRL's estimators, which no loss's keys say
    keys += [*getattr(getattr(loss, "actor_network", None), "dist_params_keys", ())]
    return [key for key in dict.fromkeys(keys) if key in present]


def check(
    loss: nn.Module,
    advantage: Any,
    optimizer: Optimizer,
    batch: TensorDictBase,
    source: str = "the rollout",
    settings: Mapping[str, Any] | None = None,
) -> list[str]:
    """Runs the loss once on ``batch`` and checks the chain; returns the names of the loss's entries.

    In this order: one owner of gamma and lambda; form of the entries; what the loss raises, traced to the entry, who
    writes it and who reads it; the loss's result; action kind and bounds; the optimizer's parameters.

    Args:
        source: who hands the batch over.
        settings: further objects that may hold a ``gamma``, by name.

    Raises:
        UserError: one line that names the key or parameter, who writes it and who reads it, expected and found.
    """
    chain = Chain(loss, advantage, source)
    owners.check_settings(chain, dict(settings or {}))
    entries.check_form(chain, batch)
    return undone(loss.buffers(), lambda: _trial(chain, optimizer, batch))  # a forward pass may update statistics


def _trial(chain: Chain, optimizer: Optimizer, batch: TensorDictBase) -> list[str]:
    out = _run(chain, batch)
    _check_result(chain, batch, out)
    if reason := entries.wrong_action(chain, batch):
        raise UserError(reason)
    total = torch.stack([out[key].sum() for key in out.keys() if is_loss(key)]).sum()
    owners.check_parameters(chain, optimizer, total)
    return [key for key in out.keys() if out[key].numel() == 1]


def _run(chain: Chain, batch: TensorDictBase) -> TensorDictBase:
    try:
        return _without_tables(chain, batch)
    except UserError:
        raise
    except (KeyError, ValueError, TypeError, RuntimeError, IndexError) as error:
        reason = entries.explain(chain, batch, error)
        if reason is None:
            raise
        raise UserError(reason) from error


def _without_tables(chain: Chain, batch: TensorDictBase) -> TensorDictBase:
    try:
        with NoTables(chain.name):
            return chain.loss(batch.copy())
    except TableError as error:
        if reason := entries.wrong_action(chain, batch):
            raise UserError(reason) from error
        try:
            with NoTables(chain.name):  # with fewer rows, as a network may have as many features
                chain.loss(batch[:-1])
        except TableError:
            raise error from None
        return chain.loss(batch.copy())


def _check_result(chain: Chain, batch: TensorDictBase, out: TensorDictBase) -> None:
    if not hasattr(out, "keys"):
        raise UserError(
            f"{chain.name} returned a {type(out).__name__}: return a TensorDict or dict, every entry that begins with "
            "'loss_' is minimized"
        )
    losses = [key for key in out.keys() if is_loss(key)]
    if not losses:
        raise UserError(
            f"{chain.name} returned no entry that begins with 'loss_' (only {', '.join(out.keys())}): the sum of "
            "those is what the update minimizes"
        )
    bad = [key for key in losses if out[key].numel() != 1]
    if bad:
        raise UserError(
            f"{chain.name} returned '{bad[0]}' of shape {tuple(out[bad[0]].shape)}, the update expects one number: "
            "take the mean (reduction='mean')"
        )
    entries.check_values(chain, batch, out, losses)
