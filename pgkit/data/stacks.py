"""Observations that stack ``k`` frames along their first dimension, the newest last, as single frames and back."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pgkit.errors import UserError, check_whole_number
from pgkit.seams import Entries, Key


def check(frame_stack: Mapping[Key, int] | int | None, observation: Entries, steps: int) -> dict[Key, int]:
    """How many frames each stacked observation has, from what a user gives; observations of one frame are left out.

    Raises:
        UserError: an observation is not there or no stack of so many frames, or a buffer of ``steps`` is shorter.
    """
    if isinstance(frame_stack, int):
        if len(observation) > 1:
            raise UserError(f"frame_stack={frame_stack}: say of which of {', '.join(map(str, observation))}, as a dict")
        frame_stack = dict.fromkeys(observation, frame_stack)
    for key, k in (frame_stack or {}).items():
        check_whole_number(1, **{f"frame_stack[{key!r}]": k})
        if key not in observation:
            raise UserError(
                f"frame_stack: there is no '{key}', the observations are {', '.join(map(str, observation))}"
            )
        shape = tuple(observation[key].shape)
        if not shape or shape[0] % k:
            raise UserError(
                f"frame_stack: '{key}' is {shape}, which is no stack of {k} frames along the first dimension (channels)"
            )
        if k > steps:
            raise UserError(
                f"a stack of {k} frames ('{key}') is longer than the {steps} steps that the replay keeps of each "
                "environment: raise the capacity (--buffer-size)"
            )
    return {key: k for key, k in (frame_stack or {}).items() if k > 1}


def newest(x: Tensor, k: int) -> Tensor:
    """The newest frames ``[B, C, ...]`` of stacks ``[B, kC, ...]``."""
    return x if k == 1 else x.narrow(1, x.shape[1] - x.shape[1] // k, x.shape[1] // k)


def gather(frames: Tensor, rows: Tensor) -> Tensor:
    """The stacks ``[B, kC, ...]`` of the frames ``[rows, C, ...]`` at rows ``[B, k]``."""
    flat = frames.flatten(1)
    if frames.dtype is torch.uint8 and flat.shape[1] % 8 == 0:
        flat = flat.view(torch.int64)  # eight at once: compiled, a copy of single bytes takes ten times as long
    picked = flat.index_select(0, rows.flatten().to(frames.device)).view(frames.dtype)
    return picked.view(len(rows), rows.shape[1] * frames.shape[1], *frames.shape[2:])


def begins(before: Tensor, now: Tensor, k: int) -> Tensor:
    """Where stacks ``[B, kC, ...]`` do not continue those ``before`` them by one frame, ``[B]``."""
    size = now.shape[1] - now.shape[1] // k
    return (before[:, -size:] != now[:, :size]).flatten(1).any(1)


def repeats(x: Tensor, k: int) -> Tensor:
    """Which stacks ``[B, kC, ...]`` are one frame, repeated."""
    frames = x.unflatten(1, (k, -1))
    return (frames == frames[:, -1:]).flatten(1).all(1)


def older(x: Tensor, k: int, depth: int) -> Tensor:
    """The ``depth`` frames before the newest, oldest first, ``[B * depth, C, ...]``; of fewer, the first again."""
    position = (torch.arange(depth) - (depth + 1 - k)).clamp_min(0)
    return x.unflatten(1, (k, -1))[:, position].flatten(0, 1)


def pointers(before: Tensor, own: Tensor, begins: Tensor, columns: int) -> Tensor:
    """The rows of older frames: of the steps before in the column, since the newest stack that ``begins`` anew.

    Args:
        before: rows of the stacks of the step before, ``[columns, depth + 1]``, the newest last.
        own: rows of the stacks as if all began here, ``[T * columns, depth + 1]``.
        begins: which do, ``[T * columns]``.
        columns: of the table.

    Returns:
        ``[T * columns, depth]``, oldest first.
    """
    stacks = torch.cat([before, own]).unflatten(0, (-1, columns))  # [T + 1, columns, depth + 1]
    depth = stacks.shape[2] - 1
    time = torch.arange(len(stacks)).view(-1, 1, 1)
    begun = torch.cat([torch.ones(columns, dtype=torch.bool), begins]).view(-1, columns, 1)
    base = torch.where(begun, time, 0).cummax(0).values
    since = time - base
    position = torch.arange(depth)
    steps_back = depth - position
    here = since >= steps_back  # that frame is of a step after the beginning
    step = torch.where(here, time - steps_back, base)
    place = torch.where(here, depth, position + since)
    return stacks[step, torch.arange(columns).view(1, -1, 1), place][1:].flatten(0, 1)
