"""Checkpoints: everything that a resumed run needs to go on bit for bit."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import nn

from pgkit import files
from pgkit.errors import EnvironmentFailed, UserError
from pgkit.seams import Stateful

_KINDS = {"recipe": str, "frames": int, "states": dict, "rng": dict, "counters": dict}


def load(path: Path) -> dict[str, Any]:
    """What ``files.save`` wrote; a UserError if it is not there or damaged, with a checkpoint that is whole."""
    if not path.is_file():
        raise UserError(f"{path.parent.parent} has no checkpoint {path.name}: nothing was saved there yet")
    try:
        saved = files.load(path)
    except UserError as error:
        other = path.with_name("latest.pt" if path.stem == "best" else "best.pt")
        if not files.is_whole(other):
            raise
        raise UserError(f"{error}; {other} is whole: --resume {other}, --which {other.stem}") from error
    if not isinstance(saved, dict) or any(not isinstance(saved.get(key), kind) for key, kind in _KINDS.items()):
        raise UserError(f"{path} is damaged: it is no checkpoint")
    return saved


@contextlib.contextmanager
def damage(run_dir: Path) -> Iterator[None]:
    """A UserError in place of what a checkpoint of another structure raises."""
    try:
        yield
    except UserError:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError) as error:
        raise UserError(f"the checkpoint of {run_dir} is damaged: {str(error).splitlines()[0]}") from error


def restore(tracked: dict[str, Stateful], states: dict[str, Any], where: Path) -> None:
    """Load each state into the object of its name; a UserError names one that is missing or does not fit."""
    if tracked.keys() != states.keys():
        held, asked = ", ".join(sorted(states)), ", ".join(sorted(tracked))
        raise UserError(
            f"{where} holds the state of {held}, but this recipe tracks {asked}: resume with its own recipe"
        )
    for name, owner in tracked.items():
        try:
            owner.load_state_dict(states[name])
        except (UserError, EnvironmentFailed):
            raise
        except (RuntimeError, KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
            reason = (str(error).strip() or "no reason given").splitlines()[-1].strip()
            raise UserError(
                f"{where}: the state of {name} does not fit what the recipe built: networks and optimizers keep their "
                f"settings on a resume ({reason})"
            ) from error


def finite(module: nn.Module) -> bool:
    """Whether every weight is finite, and no buffer has a NaN."""
    weights = all(bool(torch.isfinite(p).all()) for p in module.parameters())
    return weights and not any(bool(b.isnan().any()) for b in module.buffers() if b.is_floating_point())
