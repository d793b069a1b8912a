"""The order of an update's minibatches, and the means of its metrics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor


def minibatches(
    rows: int, size: int, generator: torch.Generator, device: torch.device | None, together: int = 1
) -> Iterator[tuple[Tensor, ...]]:
    """All rows in a new order, in minibatches; so many ``together`` make one step. The last ones may be smaller.

    The order is drawn on the CPU: it is the same on every device.
    """
    order = torch.randperm(rows, generator=generator)
    parts = (order if device is None else order.to(device)).split(size)
    yield from (parts[first : first + together] for first in range(0, len(parts), together))


def means(names: Sequence[str], results: Sequence[Tensor]) -> dict[str, float]:
    """The metrics of several steps, averaged, off the device at once."""
    mean = torch.stack(tuple(results)).mean(0) if len(results) > 1 else results[0]
    return dict(zip(names, mean.tolist(), strict=True))
