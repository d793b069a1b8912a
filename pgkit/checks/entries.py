"""The check of a batch's entries: shapes, types, actions, values."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pgkit.checks.keys import following, kind, rows, shape, show
from pgkit.checks.view import LossView, bounds
from pgkit.errors import UserError

WITH_A_TRAILING_1 = ("advantage", "value_target", "value")
OF_THE_NEXT_STATE = ("reward", "done", "terminated")


def check_form(view: LossView, batch: TensorDictBase) -> None:
    """Silent shape errors that a loss would accept: ``(B,)`` for ``(B, 1)``, numbers for flags.

    In a group of ``A`` agents they are ``(B, A)`` and ``(B, A, 1)``.
    """
    flags = [following(key) for key in (*view.keys("done"), *view.keys("terminated"))]
    keys = [key for name in WITH_A_TRAILING_1 for key in view.keys(name)]
    for key in [*keys, *map(following, view.keys("reward")), *flags]:
        x = batch.get(key, None)
        if not isinstance(x, Tensor):
            continue
        size = rows(batch, key)
        if x.requires_grad:
            raise wrong(view, key, "part of a graph", "no gradient", "compute it under torch.no_grad()")
        if tuple(x.shape) == size:
            raise wrong(view, key, shape(x), str((*size, 1)), "keep the trailing 1, unsqueeze(-1)")
        if key in flags and x.dtype != torch.bool:
            raise wrong(view, key, kind(x), "bool", "make it a flag, x.bool()")
    for key in view.keys("sample_log_prob"):
        x = batch.get(key, None)
        if isinstance(x, Tensor) and tuple(x.shape) == (*rows(batch, key), 1):
            advice = "one number a row, squeeze(-1), or a distribution over the whole action (IndependentNormal)"
            raise wrong(view, key, shape(x), str(rows(batch, key)), advice)


def check_action(view: LossView, batch: TensorDictBase) -> None:
    """The batch's actions against the actor's distribution: their kind, shape and bounds."""
    keys, dist = view.keys("action"), view.distribution(batch)
    action = batch.get(keys[0], None) if len(keys) == 1 else None
    sample = None if dist is None else dist.sample()
    if not isinstance(action, Tensor) or not isinstance(sample, Tensor):
        return
    reader = f"the actor's {type(dist).__name__}"
    if sample.shape != action.shape or sample.dtype.is_floating_point != action.dtype.is_floating_point:
        found, expected = (f"{shape(x)} {kind(x)}" for x in (action, sample))
        raise wrong(view, keys[0], found, expected, "was the actor built for this environment?", reader)
    low, high = bounds(dist)
    if low is None or high is None or not action.numel():
        return
    slack = 1e-4
    if (action < low - slack).any() or (action > high + slack).any():
        found = f"between {action.min():g} and {action.max():g}"
        expected = f"between {torch.as_tensor(low).min():g} and {torch.as_tensor(high).max():g}"
        advice = "build the actor from the environment that collects, or clip the stored actions"
        raise wrong(view, keys[0], found, expected, advice, reader)


def another_policy(view: LossView, batch: TensorDictBase) -> str | None:
    """Whether the batch's log-probabilities are far from those of the loss's actor; None if all is well."""
    keys, dist = [*view.keys("action"), *view.keys("sample_log_prob")], view.distribution(batch)
    stored = [batch.get(key, None) for key in keys]
    if dist is None or len(stored) != 2 or stored[1] is None:
        return None
    try:
        gap = float((dist.log_prob(stored[0]) - stored[1]).abs().mean())
    except (ValueError, RuntimeError, NotImplementedError):
        return None
    if gap < 0.01:
        return None
    return (
        f"the log-probabilities of the first batch differ by {gap:.2g} on average from those of {view.name}'s actor: "
        "is the loss built on the actor that collects?"
    )


def check_values(view: LossView, batch: TensorDictBase, out: Any, losses: list[str]) -> None:
    """A loss that is not finite is traced to the entry that is to blame."""
    bad = [key for key in losses if not out[key].isfinite().all()]
    if not bad:
        return
    for key in view.in_keys or batch.keys(True, True):
        x = batch.get(key, None)
        if isinstance(x, Tensor) and not x.isfinite().all():
            random = "; frames collected with random actions have no log-probability"
            raise UserError(
                f"'{show(key)}' has {int((~x.isfinite()).sum())} of {x.numel()} values that are not finite, expected "
                f"none by {view.reader(key)}, whose '{bad[0]}' is {out[bad[0]].sum():g}; written by "
                f"{view.origin(key)}{random if key in view.keys('sample_log_prob') else ''}"
            )
    raise UserError(
        f"'{bad[0]}' of {view.name} is {out[bad[0]].sum():g} on a batch whose entries are all finite: expected a "
        "finite number; look at the network's weights and at the loss's settings"
    )


def wrong(view: LossView, key: Any, found: str, expected: str, advice: str, reader: str | None = None) -> UserError:
    """An entry that is not what its reader expects."""
    by = reader or view.reader(key)
    return UserError(f"'{show(key)}' is {found}, expected {expected} by {by}; written by {view.origin(key)}: {advice}")
