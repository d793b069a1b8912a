"""The one look at an assembled agent, before its first step."""

from __future__ import annotations

from collections.abc import Mapping
from logging import getLogger
from typing import Any

import torch
from tensordict import TensorDictBase
from torch.optim import Optimizer
from torch.utils.weak import WeakTensorKeyDictionary

from pgkit.checks import entries, explain, owners, rollouts
from pgkit.checks.broadcasts import BroadcastError, NoBroadcasts
from pgkit.checks.keys import is_loss
from pgkit.checks.view import LossView, result_of
from pgkit.errors import UserError

_SEEN = WeakTensorKeyDictionary()  # parameters of the actors that an update has looked at, and may have trained since


def assembly(
    view: LossView,
    optimizer: Optimizer,
    batch: TensorDictBase,
    *,
    rollout: TensorDictBase | None = None,
    owners_of_gamma: Mapping[str, Any] | None = None,
    resumed: bool = False,
) -> list[str]:
    """Runs the loss once on ``batch`` and checks the whole agent; returns the names of the loss's entries.

    In this order: the rollout's order in time; one memory; one owner of gamma and lambda; form of the entries; what the
    loss raises, traced to the entry, who writes it and who reads it; the loss's result; action kind and bounds; the
    optimizer's parameters. It warns where another policy seems to have collected.

    The loss's statistics and the random generators may move: an update undoes that.

    Args:
        view: the loss, the advantage block, and who hands the batch over.
        optimizer: of all that is trained.
        batch: rows as the loss gets them.
        rollout: what the batch was drawn from, ``[num_envs, T]``; None: no order in time.
        owners_of_gamma: further objects that may hold a ``gamma``, by name.
        resumed: training goes on, so older weights than the actor's may have collected.

    Raises:
        UserError: one line that names the key or parameter, who writes it and who reads it, expected and found.
    """
    if rollout is not None and (view.advantage is not None or view.estimator is not None):
        rollouts.check_order(view, rollout)
    rollouts.check_one_memory(view)
    owners.check_discounts(view, owners_of_gamma or {})
    entries.check_form(view, batch)
    out = _trial(view, batch)
    _check_result(view, batch, out)
    entries.check_action(view, batch)
    total = torch.stack([out[key].sum() for key in out.keys() if is_loss(key)]).sum()
    owners.check_parameters(view, optimizer, total)
    _warn_of_another_policy(view, batch, resumed)
    return [key for key in out.keys() if out[key].numel() == 1]


def _trial(view: LossView, batch: TensorDictBase) -> TensorDictBase:
    """The loss's result; what it raises is explained."""
    estimator = view.estimator
    try:
        out = _without_broadcasts(view, batch)
    except UserError:
        raise
    except (KeyError, ValueError, TypeError, RuntimeError, IndexError) as error:
        explain.explain(view, batch, error)
        raise
    if view.estimator is not estimator and view.lacks_advantage(batch):  # it would take a minibatch's rows for steps
        view.estimator = estimator
        raise explain.unwritten(view, view.key("advantage"))
    return out


def _without_broadcasts(view: LossView, batch: TensorDictBase) -> TensorDictBase:
    try:
        with NoBroadcasts(view.name):
            return result_of(view.loss, batch.copy())
    except BroadcastError as error:
        entries.check_action(view, batch)
        try:
            with NoBroadcasts(view.name):  # with fewer rows, as a network may have as many features
                result_of(view.loss, batch[:-1])
        except BroadcastError:
            raise error from None
        return result_of(view.loss, batch.copy())


def _check_result(view: LossView, batch: TensorDictBase, out: Any) -> None:
    if not isinstance(out, TensorDictBase | Mapping):
        raise UserError(
            f"{view.name} returned a {type(out).__name__}: return a TensorDict or dict, every entry that begins with "
            "'loss_' is minimized"
        )
    losses = [key for key in out.keys() if is_loss(key)]
    if not losses:
        raise UserError(
            f"{view.name} returned no entry that begins with 'loss_' (only {', '.join(out.keys())}): the sum of "
            "those is what the update minimizes"
        )
    bad = [key for key in losses if out[key].numel() != 1]
    if bad:
        raise UserError(
            f"{view.name} returned '{bad[0]}' of shape {tuple(out[bad[0]].shape)}, the update expects one number: "
            "take the mean (reduction='mean')"
        )
    entries.check_values(view, batch, out, losses)


def _warn_of_another_policy(view: LossView, batch: TensorDictBase, resumed: bool) -> None:
    """Not where an earlier update has looked at the same actor: it may have trained it since the rollout."""
    actor = [p for p in view.parameters("actor_network") if p.requires_grad]
    fresh = not any(p in _SEEN for p in actor)
    for p in actor:
        _SEEN[p] = True
    if fresh and not resumed and view.source == "the rollout" and (reason := entries.another_policy(view, batch)):
        getLogger("pgkit").warning(reason)
