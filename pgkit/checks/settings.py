"""The check of an update's settings: each within its bounds, and none against another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pgkit.checks.view import LossView, setting
from pgkit.errors import UserError, check_whole_number, within
from pgkit.optim import check_optimizer, parameters
from pgkit.seams import KeepsDistribution

ANY = float("inf")
COUNTS = ("epochs", "minibatch_size", "sequence_length", "batch_size", "actor_delay", "cg_steps", "accumulate")
BOUNDS = {  # name: least, greatest, kind
    **dict.fromkeys(COUNTS, (1, ANY, int)),
    **dict.fromkeys(("target_kl", "updates_per_step", "max_kl", "damping"), (0, ANY, float)),
    "tau": (0, 1, float),
}


def check_settings(view: LossView, settings: Mapping[str, Any]) -> None:
    """The settings of an update by name, when it is built; names that are not checked may be among them.

    Raises:
        UserError: a setting is out of bounds, or contradicts another, the loss or the replay.
    """
    if settings["optimizer"] is not None or "max_kl" not in settings:  # a trust region may have none
        check_optimizer(settings["optimizer"])
    for name, (low, high, kind) in BOUNDS.items():
        given = {name: settings.get(name)}
        check_whole_number(low, **given) if kind is int else within(low, high, **given)
    for contradictions in (_of_schedules, _of_minibatches, _of_replays, _of_trust_regions):
        for message in contradictions(view, settings):
            raise UserError(message)


def _of_schedules(view: LossView, settings: Mapping[str, Any]) -> Iterator[str]:
    schedules = settings.get("schedules") or {}
    if schedules and settings["total_frames"] is None:
        yield "schedules are functions of the progress: give total_frames too"
    for name, schedule in schedules.items():
        if not callable(schedule):
            yield (
                f"schedules: '{name}' is {schedule!r}, give a function of the progress in [0, 1] (controllers.linear)"
            )
        if name not in ["lr", *view.coefficients()]:
            known = ", ".join(["lr", *sorted(view.coefficients())])
            yield f"schedules: {view.name} has no coefficient '{name}', only {known}"


def _of_minibatches(view: LossView, settings: Mapping[str, Any]) -> Iterator[str]:
    size, length = settings.get("minibatch_size"), settings.get("sequence_length")
    if settings.get("normalize_advantage") and setting(view.loss, "normalize_advantage"):
        yield f"{view.name} normalizes the advantage already: leave normalize_advantage out here"
    if size and length and size % length:
        yield (
            f"minibatch_size={size} is not a multiple of sequence_length={length}: a minibatch is made of whole "
            "sequences"
        )


def _of_replays(view: LossView, settings: Mapping[str, Any]) -> Iterator[str]:
    if "learning_starts" not in settings:
        return
    start, size, total = settings["learning_starts"], settings["batch_size"], settings["total_frames"]
    if start < size:
        yield (
            f"batch_size={size} is above the learning_starts={start} frames stored at the first update: raise "
            "learning_starts or lower batch_size"
        )
    if settings["capacity"] < start:
        yield (
            f"the replay has at most {settings['capacity']:,} frames to draw from and updates begin at "
            f"learning_starts={start:,}: raise its capacity (--buffer-size) or lower learning_starts "
            "(--random-frames, --batch-size)"
        )
    if total is not None and total < start:
        yield (
            f"total_frames={total:,} end before updates begin at learning_starts={start:,}: raise the first or lower "
            "the second (--random-frames, --batch-size)"
        )


def _of_trust_regions(view: LossView, settings: Mapping[str, Any]) -> Iterator[str]:
    if "max_kl" not in settings:
        return
    if not isinstance(view.loss, KeepsDistribution):
        yield f"a trust region needs a loss with kl() and keep_distribution(), {view.name} has none: losses.TRPOLoss"
    actor = {id(p) for p in view.parameters("actor_network")}
    optimizer = settings["optimizer"]
    if optimizer is not None and any(id(p) in actor for p in parameters(optimizer)):
        yield (
            "TrustRegionUpdate steps the actor itself: build the optimizer from critic.parameters() alone, and share "
            "no layers between the two"
        )
