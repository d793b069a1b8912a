"""What a loss raised on its first batch, in words: traced to the entry, who writes it and who reads it."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from pgkit.checks.entries import check_action, wrong
from pgkit.checks.keys import is_next, kind, last, shape, show
from pgkit.checks.view import LossView, run
from pgkit.errors import UserError
from pgkit.seams import KeepsDistribution


def explain(view: LossView, batch: TensorDictBase, error: Exception) -> None:
    """Raises why the loss could not take the batch, unless there is nothing better to say than ``error``."""
    for name, (net, params) in view.networks().items():
        missing = [key for key in net.in_keys if key not in batch.keys(True) and key != "_"]
        if missing:
            raise _missing(view, batch, missing[0], f"{name} of {view.name}")
        _check_inputs(view, batch, name, net, params)
    text = " ".join(map(str, error.args))
    named = [key for key in view.in_keys if last(key) in text and key not in batch.keys(True)]
    if named:
        raise _missing(view, batch, max(named, key=lambda key: len(show(key))), view.name)  # one may begin another
    check_action(view, batch)
    if isinstance(error, KeyError):
        text += "; what forward reads besides is named in loss.in_keys (override _reads)"
    elif not isinstance(error, ValueError | TypeError):
        return
    present = ", ".join(f"{show(key)} {shape(batch[key])}" for key in batch.keys(True, True))
    raise UserError(f"{view.name} cannot read its batch: {text}. The batch has {present}")


def unwritten(view: LossView, key: Any) -> UserError:
    """There is no advantage, or no value target, as there is no advantage block."""
    return UserError(
        f"the rollout has no '{show(key)}', which {view.name} reads; nothing writes it, as there is no advantage "
        "block: add advantage=advantages.GAE(critic)"
    )


def _check_inputs(view: LossView, batch: TensorDictBase, name: str, net: Any, params: Any) -> None:
    """Whether a network can take its entries."""
    entries = batch.select(*net.in_keys)
    try:
        run(net, params, lambda: net(entries.copy()))
    except (RuntimeError, ValueError, IndexError) as error:
        weight = next((p for p in params.values(True, True) if p.dtype.is_floating_point), None)
        for key in net.in_keys:
            x = entries[key]
            if weight is None or not isinstance(x, Tensor):
                continue
            if x.device != weight.device:
                advice = f"move one of them, x.to('{weight.device}')"
                raise wrong(view, key, f"on {x.device}", f"on {weight.device}", advice) from error
            if x.dtype.is_floating_point and x.dtype != weight.dtype:
                advice = "convert it (TorchRL: DoubleToFloat), or the network with .to(dtype)"
                raise wrong(view, key, kind(x), kind(weight), advice) from error
        found = ", ".join(f"'{show(key)}' {shape(entries[key])}" for key in net.in_keys)
        raise UserError(
            f"{name} of {view.name} cannot take {found} ({str(error).splitlines()[0]}); written by "
            f"{view.origin(net.in_keys[0])}: was the network built for this environment?"
        ) from error


def _missing(view: LossView, batch: TensorDictBase, key: Any, reader: str) -> UserError:
    if key in (view.key("advantage"), view.key("value_target")):
        if view.advantage is None:
            return unwritten(view, key)
        written = ", ".join(map(show, view.estimates))
        advice = f"{view.advantage_name} writes {written}: use one name, or loss.set_keys(...)"
    elif view.source != "the rollout" and reader == view.name and not is_next(key):
        advice = (
            f"the frames stored must have it, and pgkit's replay be told to keep it: entries={{{key!r}: an example}}"
        )
    elif key in view.keys("sample_log_prob"):
        advice = "the actor should write it: build it with return_log_prob=True"
    elif isinstance(view.loss, KeepsDistribution) and key in view.distribution_keys:
        advice = "a parameter of the distribution that acted: update(loss.keep_distribution(rollout)) writes it"
    else:
        advice = f"{view.origin(key)} should write it: use one name, or loss.set_keys(...), or in_keys=[...]"
    present = ", ".join(map(show, batch.keys(True, True)))
    return UserError(f"the batch has no '{show(key)}', which {reader} reads; {advice}. The batch has {present}")
