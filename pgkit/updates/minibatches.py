"""From a rollout to minibatches: rows or sequences, their order, and the means of the metrics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pgkit.errors import UserError


def as_rows(data: TensorDictBase, length: int | None) -> TensorDictBase:
    """The rows that minibatches are drawn from: ``[rows]``, or sequences ``[rows, length]`` of successive steps.

    Raises:
        UserError: recurrent networks without a length, or a length that does not divide the rollout's steps.
    """
    if length is None:
        if any(key == "recurrent_state" or key[-1] == "recurrent_state" for key in data.keys(True)):
            raise UserError(
                "the networks are recurrent, single rows do not train their memory: use OnPolicyUpdate with "
                "sequence_length= (16, say)"
            )
        return data.reshape(-1).contiguous()
    if data.batch_size[-1] % length:
        raise UserError(
            f"sequence_length={length} does not divide the {data.batch_size[-1]} steps that each environment takes for "
            "a rollout: change one of them"
        )
    return data.reshape(-1, length).contiguous()


def minibatches(
    rows: int, size: int, generator: torch.Generator, device: torch.device, together: int = 1
) -> Iterator[tuple[Tensor, ...]]:
    """All rows in a new order, in minibatches; so many ``together`` make one step. The last ones may be smaller.

    The order is drawn on the CPU: it is the same on every device.
    """
    parts = torch.randperm(rows, generator=generator).to(device).split(size)
    yield from (parts[first : first + together] for first in range(0, len(parts), together))


def frames_of(rollout: TensorDictBase) -> int:
    """Frames of a rollout: the steps whose action counted."""
    mask = rollout.get(("collector", "mask"), None)
    return rollout.numel() if mask is None else int(mask.sum())


def means(names: Sequence[str], results: Sequence[Tensor]) -> dict[str, float]:
    """The metrics of several steps, averaged, off the device at once.

    Skipped steps, of which the last metric is 1, are left out, but for that metric; unless all were.
    """
    every = torch.stack(tuple(results)).cpu()
    taken = every[every[:, -1] == 0]
    mean = (taken if len(taken) else every).mean(0).tolist()
    return dict(zip(names, [*mean[:-1], every[:, -1].mean().item()], strict=True))
