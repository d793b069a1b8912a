"""Random state: seed it once, save it in a checkpoint, keep evaluation from touching it."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch


def seed_everything(seed: int) -> None:
    """Seed Python, NumPy and PyTorch (all devices)."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def evaluation_seed(seed: int, frames: int) -> int:
    """Env seed of the evaluation after ``frames``: new each time, the same after a resume."""
    return int(np.random.SeedSequence([seed, 0xE7A1, frames]).generate_state(1)[0] >> 1)


def rng_state() -> dict[str, Any]:
    """The state of the three global generators (and of every CUDA device, if there is one)."""
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": torch.get_rng_state(),
        "cuda": cuda,
    }


def set_rng_state(state: dict[str, Any]) -> None:
    """Undo everything drawn since ``state = rng_state()``."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    torch.set_rng_state(state["torch"])
    if state["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["cuda"])


@contextmanager
def preserved_rng() -> Iterator[None]:
    """Leave the global generators as they were, whatever the block draws."""
    state = rng_state()
    try:
        yield
    finally:
        set_rng_state(state)
