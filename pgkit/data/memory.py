"""Whether a table fits, before it is allocated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pgkit.errors import UserError

_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def check_fits(capacity: int, tables: Mapping[Any, tuple[Tensor, int]], device: torch.device) -> None:
    """A ``UserError`` where tensors of so many rows are more than the memory that is free, with the sizes.

    Args:
        capacity: frames, for the message.
        tables: by name, an example of a row and the number of rows.
        device: where they are to be.
    """
    sizes = {str(name): rows * x.numel() * x.element_size() for name, (x, rows) in tables.items()}
    free, needed = free_memory(device), sum(sizes.values())
    if free is not None and needed > free:
        largest = max(sizes, key=lambda name: sizes[name])
        raise UserError(
            f"a replay of {capacity:,} frames takes {needed / 1e9:,.1f} GB, {sizes[largest] / 1e9:,.1f} of them for "
            f"'{largest}', and {free / 1e9:,.1f} GB of memory are free: lower the capacity (--buffer-size), store the "
            "frames of stacks once (frame_stack=...), or keep it in files (storage=data.in_files(folder))"
        )


def free_memory(device: torch.device) -> int | None:
    """Bytes that can be had there, by the system and by the limits of a container; None where nobody says."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        free = [int(lines["MemAvailable"].split()[0]) * 1024]
    except (OSError, KeyError, ValueError):
        return None
    for path in _LIMITS:
        try:
            free.append(int(Path(path).read_text()))
        except (OSError, ValueError):  # no such group, or "max"
            continue
    return min(free)
