"""Checkpoints: everything that a resumed run needs to go on bit for bit, each file replaced in one step."""

import os
import pickle
from pathlib import Path
from typing import Any, Protocol

import cloudpickle
import torch

from pgkit.errors import UserError


class Stateful(Protocol):
    """What a run can save and restore."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state_dict: Any, /) -> Any: ...


def save(path: Path, content: Any) -> None:
    """Write ``content`` to ``path`` in one step: a crash leaves the old file or the new one, never half.

    Classes defined in the recipe itself are saved by value, so the file opens without the recipe.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".tmp")
    torch.save(content, temporary, pickle_module=cloudpickle)
    os.replace(temporary, path)


def load(path: Path) -> Any:
    """What ``save`` wrote, on the CPU. It unpickles: open only run directories that you trust."""
    if not path.is_file():
        raise UserError(f"{path.parent.parent} has no checkpoint {path.name}: nothing was saved there yet")
    try:
        return torch.load(path, map_location="cpu", weights_only=False)
    except (ImportError, AttributeError) as error:
        raise UserError(
            f"{path} needs code that is not found ({error}): run this where the recipe's own modules are, or put their "
            "folder on PYTHONPATH"
        ) from error
    except (RuntimeError, EOFError, OSError, pickle.UnpicklingError) as error:
        raise UserError(f"{path} is damaged: {str(error).splitlines()[0]}") from error


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
        except (RuntimeError, KeyError, IndexError, ValueError) as error:
            reason = str(error).strip().splitlines()[-1].strip()
            raise UserError(
                f"{where}: the state of {name} does not fit what the recipe built: networks and optimizers keep their "
                f"settings on a resume ({reason})"
            ) from error
