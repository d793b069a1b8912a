"""The check of a batch's entries: shapes, dtypes, devices, sizes, values."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pgkit.errors import UserError
from pgkit.updates.chain import Chain, following, run, shape, show

WITH_A_TRAILING_1 = ("advantage", "value_target", "value")
OF_THE_NEXT_STATE = ("reward", "done", "terminated")


def check_form(chain: Chain, batch: TensorDictBase) -> None:
    """What a loss may take without a word and get wrong: ``(B,)`` for ``(B, 1)``, numbers for flags."""
    keys = [key for name in WITH_A_TRAILING_1 for key in chain.keys(name)]
    keys += [following(key) for name in OF_THE_NEXT_STATE for key in chain.keys(name)]
    size = tuple(batch.batch_size)
    for key in keys:
        x = batch.get(key, None)
        if isinstance(x, Tensor) and x.requires_grad:
            raise _wrong(chain, key, "part of a graph", "no gradient", "compute it under torch.no_grad()")
        if isinstance(x, Tensor) and tuple(x.shape) == size:
            raise _wrong(chain, key, shape(x), str((*size, 1)), "keep the trailing 1, unsqueeze(-1)")
    for key in chain.keys("sample_log_prob"):
        x = batch.get(key, None)
        if isinstance(x, Tensor) and tuple(x.shape) == (*size, 1):
            advice = "one number a row, squeeze(-1), or a distribution over the whole action (IndependentNormal)"
            raise _wrong(chain, key, shape(x), str(size), advice)
    for key in map(following, [*chain.keys("done"), *chain.keys("terminated")]):
        x = batch.get(key, None)
        if isinstance(x, Tensor) and x.dtype != torch.bool:
            raise _wrong(chain, key, _type(x), "bool", "make it a flag, x.bool()")


def explain(chain: Chain, batch: TensorDictBase, error: Exception) -> str | None:
    """Why the loss could not take the batch, as one line; None where there is nothing better to say than ``error``."""
    for name, (net, params) in chain.networks().items():
        missing = [key for key in net.in_keys if key not in batch.keys(True) and key != "_"]
        if missing:
            return _missing(chain, batch, missing[0], f"{name} of {chain.name}")
        if reason := _refused(chain, batch, name, net, params):
            return reason
    text = " ".join(map(str, error.args))
    named = [key for key in _read(chain) if (key if isinstance(key, str) else key[-1]) in text]
    missing = [key for key in named if key not in batch.keys(True)]
    if missing:
        return _missing(chain, batch, missing[0], chain.name)
    if reason := wrong_action(chain, batch):
        return reason
    if isinstance(error, RuntimeError | IndexError):
        return None
    present = ", ".join(f"{show(key)} {shape(batch[key])}" for key in batch.keys(True, True))
    advice = "; what forward reads besides is named in loss.in_keys (override _reads)" * isinstance(error, KeyError)
    return f"{chain.name} cannot read its batch: {text}{advice}. The batch has {present}"


def wrong_action(chain: Chain, batch: TensorDictBase) -> str | None:
    """The batch's actions against the actor's distribution: their kind, shape and bounds; None if all is well."""
    keys, dist = chain.keys("action"), chain.distribution(batch)
    key = keys[0] if len(keys) == 1 else None
    action = batch.get(key, None) if key else None
    if dist is None or not isinstance(action, Tensor):
        return None
    sample = dist.sample()
    if not isinstance(sample, Tensor):
        return None
    kind = f"the actor's {type(dist).__name__}"
    if sample.shape != action.shape or sample.dtype.is_floating_point != action.dtype.is_floating_point:
        advice = "was the actor built for this environment?"
        found, expected = (f"{shape(x)} {_type(x)}" for x in (action, sample))
        return str(_wrong(chain, key, found, expected, advice, reader=kind))
    low, high = getattr(dist, "low", None), getattr(dist, "high", None)
    if low is None and not sample.dtype.is_floating_point and hasattr(dist, "logits"):
        low, high = 0, dist.logits.shape[-1] - 1
    if low is None or high is None or not action.numel():
        return None
    slack = 1e-4
    if (action < low - slack).any() or (action > high + slack).any():
        found = f"between {action.min():g} and {action.max():g}"
        bounds = f"between {torch.as_tensor(low).min():g} and {torch.as_tensor(high).max():g}"
        advice = "build the actor from the environment that collects, or clip the stored actions"
        return str(_wrong(chain, key, found, bounds, advice, reader=kind))
    return None


def another_policy(chain: Chain, batch: TensorDictBase) -> str | None:
    """Whether the first batch's log-probabilities are far from those of the loss's actor; None if all is well."""
    stored = [batch.get(key, None) for key in _log_prob(chain)]
    action, dist = [batch.get(key, None) for key in chain.keys("action")], chain.distribution(batch)
    if dist is None or len(stored) != 1 or len(action) != 1 or stored[0] is None:
        return None
    try:
        gap = float((dist.log_prob(action[0]) - stored[0]).abs().mean())
    except (ValueError, RuntimeError, NotImplementedError):
        return None
    if gap < 0.01:
        return None
    return (
        f"the log-probabilities of the first batch differ by {gap:.2g} on average from those of {chain.name}'s actor: "
        "is the loss built on the actor that collects?"
    )


def check_values(chain: Chain, batch: TensorDictBase, out: TensorDictBase, losses: list[str]) -> None:
    """A loss that is not finite is traced to the entry that is to blame."""
    bad = [key for key in losses if not out[key].isfinite().all()]
    if not bad:
        return
    for key in getattr(chain.loss, "in_keys", batch.keys(True, True)):
        x = batch.get(key, None)
        if isinstance(x, Tensor) and not x.isfinite().all():
            random = "; frames collected with random actions have no log-probability" * (key in _log_prob(chain))
            raise UserError(
                f"'{show(key)}' has {int((~x.isfinite()).sum())} of {x.numel()} values that are not finite, expected "
                f"none by {chain.reader(key)}, whose '{bad[0]}' is {out[bad[0]].sum():g}; written by "
                f"{chain.origin(key)}{random}"
            )
    raise UserError(
        f"'{bad[0]}' of {chain.name} is {out[bad[0]].sum():g} on a batch whose entries are all finite: expected a "
        "finite number; look at the network's weights and at the loss's settings"
    )


def _log_prob(chain: Chain) -> list[Any]:
    return chain.keys("sample_log_prob")


def _read(chain: Chain) -> list[Any]:
    """Entries that the loss says it reads, longest name first: one name may be the beginning of another."""
    return sorted(getattr(chain.loss, "in_keys", None) or [], key=lambda key: -len(show(key)))


def _refused(chain: Chain, batch: TensorDictBase, name: str, net: Any, params: Any) -> str | None:
    """Why a network cannot take its entries."""
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
                return str(_wrong(chain, key, f"on {x.device}", f"on {weight.device}", advice))
            if x.dtype.is_floating_point and x.dtype != weight.dtype:
                advice = "convert it (TorchRL: DoubleToFloat), or the network with .to(dtype)"
                return str(_wrong(chain, key, _type(x), _type(weight), advice))
        found = ", ".join(f"'{show(key)}' {shape(entries[key])}" for key in net.in_keys)
        return (
            f"{name} of {chain.name} cannot take {found} ({str(error).splitlines()[0]}); written by "
            f"{chain.origin(net.in_keys[0])}: was the network built for this environment?"
        )
    return None


def _missing(chain: Chain, batch: TensorDictBase, key: Any, reader: str) -> str:
    if key in (chain.key("advantage"), chain.key("value_target")):
        if chain.advantage is None:
            advice = "nothing writes it, as there is no advantage block: add advantage=advantages.GAE(critic)"
        else:
            written = ", ".join(show(k) for k in getattr(chain.advantage, "out_keys", ())) or "unknown entries"
            advice = f"{type(chain.advantage).__name__} writes {written}: use one name, or loss.set_keys(...)"
    elif isinstance(key, str) and chain.source != "the rollout" and reader == chain.name:
        advice = (
            f"the frames stored must have it, and pgkit's replay be told to keep it: entries={{'{key}': an example}}"
        )
    elif key in _log_prob(chain):
        advice = "the actor should write it: build it with return_log_prob=True"
    elif key in getattr(chain.loss, "distribution_keys", ()):
        advice = "a parameter of the distribution that acted: update(loss.keep_distribution(rollout)) writes it"
    else:
        advice = f"{chain.origin(key)} should write it: use one name, or loss.set_keys(...), or in_keys=[...]"
    present = ", ".join(show(k) for k in batch.keys(True, True))
    return f"the batch has no '{show(key)}', which {reader} reads; {advice}. The batch has {present}"


def _wrong(chain: Chain, key: Any, found: str, expected: str, advice: str, reader: str | None = None) -> UserError:
    by = reader or chain.reader(key)
    return UserError(f"'{show(key)}' is {found}, expected {expected} by {by}; written by {chain.origin(key)}: {advice}")


def _type(x: Tensor) -> str:
    return str(x.dtype).removeprefix("torch.")
