"""The check of a rollout as a sequence: rows that follow each other, and one memory."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from pgkit.checks.keys import following, is_next, last, show
from pgkit.checks.view import LossView, device_of, shape_of
from pgkit.errors import UserError
from pgkit.seams import Memory


def check_order(view: LossView, rollout: TensorDictBase) -> None:
    """A rollout's rows must be successors of each other: an advantage takes V(s'_t) from the next row.

    Compared is what the networks read and the environment writes, where the rollout has it under ``next`` too; a step
    that ends an episode, or that a mask leaves out, may lead anywhere.

    Raises:
        UserError: a step goes on where the one before it did not end.
    """
    *envs, steps = rollout.batch_size
    time, present = len(envs), set(rollout.keys(True, True))
    if steps < 2:
        return

    def rows(key: Any, start: int) -> Tensor:  # all steps but one, [*envs, steps - 1, features]
        return rollout[key].narrow(time, start, steps - 1).reshape(*envs, steps - 1, -1)

    free = torch.zeros(*envs, steps - 1, dtype=torch.bool, device=device_of(rollout))
    for key in [key for key in present if is_next(key) and last(key) == "done"]:
        free |= rows(key, 0).any(-1)
    for key in present.intersection(view.masks):
        free |= ~(rows(key, 0).all(-1) & rows(key, 1).all(-1))
    for key in view.inputs:
        after = following(key)
        if not {key, after} <= present or view.writer(after) != "environment":
            continue
        reached, seen = rows(after, 0), rows(key, 1)
        differ = (reached != seen) & ((reached == reached) | (seen == seen))  # one NaN is as good as another
        broken = differ.any(-1) & ~free
        if broken.any():
            raise UserError(_out_of_order(rollout, key, broken.nonzero()[0].tolist()))


def _out_of_order(rollout: TensorDictBase, key: Any, row: list[int]) -> str:
    *env, step = row
    if not env:
        return (
            f"the rollout of batch size {shape_of(rollout)} is not one environment's: step {step + 1} does not begin "
            f"where step {step} led. Give the rollout as [environments, steps], time last, not flattened"
        )
    return (
        f"the rollout of batch size {shape_of(rollout)} is not in order: in row {', '.join(map(str, env))}, step "
        f"{step + 1} does not begin where step {step} led ('{show(key)}'), and an advantage takes the next value from "
        "the next step. Give it as collected, [environments, steps], time last, not shuffled, stitched or flattened"
    )


def check_one_memory(view: LossView) -> None:
    """A recurrent critic must use the actor's core: a rollout has that one's state and no other.

    Raises:
        UserError: the critic has a core of its own.
    """
    actor = {id(p) for p in view.parameters("actor_network")}
    if not actor or not isinstance(view.advantage, nn.Module):
        return
    for module in view.advantage.modules():
        if isinstance(module, Memory) and any(id(p) not in actor for p in module.parameters()):
            raise UserError(
                f"the critic of {view.advantage_name} has a recurrent core of its own, the rollout has the state "
                "of the actor's only: make one core = modules.gru(env) and give it to both as encoder="
            )
