"""States in files of their own, and storages in files."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from logging import getLogger
from pathlib import Path
from typing import Any, Protocol

import torch
from torchrl.data import LazyMemmapStorage
from torchrl.data.replay_buffers import TensorStorage

from pgkit import files
from pgkit.errors import UserError
from pgkit.seams import Stateful

_log = getLogger("pgkit")


def save(owner: Stateful, path: Path) -> None:
    """Writes the state to ``path``: a crash leaves the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files.save(path, owner.state_dict())


def load(owner: Stateful, path: Path) -> None:
    """Reads what :func:`save` wrote.

    Raises:
        UserError: there is no such file, or it is damaged.
    """
    if not path.is_file():
        raise UserError(f"there is no saved replay buffer at {path}")
    saved = files.load(path)
    try:
        owner.load_state_dict(saved)
    except UserError:
        raise
    except (RuntimeError, LookupError, TypeError, ValueError) as error:
        reason = next(iter(str(error).strip().splitlines()), "entries are missing")
        raise UserError(f"{path} is no saved replay buffer ({reason}): train without it") from error


def in_files(folder: str | Path) -> Callable[[int], TensorStorage]:
    """Makes a memory-mapped storage, for a buffer beyond RAM: ``ReplayBuffer(storage=in_files(folder))``.

    Its files lie in a new folder within ``folder`` and are removed when the program ends; what is to last is saved by
    ``ReplayBuffer.save``.

    Raises:
        UserError: nothing can be written there.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        own = tempfile.mkdtemp(prefix="replay-", dir=folder)
    except OSError as error:
        raise UserError(f"the replay buffer cannot be kept in {folder}: {error.strerror}") from error
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return partial(LazyMemmapStorage, scratch_dir=own)


class Replay(Stateful, Protocol):
    """What a checkpoint needs of a replay buffer; ``written`` counts the frames it ever stored."""

    generator: torch.Generator

    @property
    def written(self) -> int: ...

    def clear(self) -> None: ...


class BesideCheckpoint:
    """A run's handle on its replay buffer: a checkpoint has its frame count, a file beside it the frames.

    Args:
        buffer: the replay buffer.
        path: its file.
        save: write that file with every checkpoint; otherwise a resumed run fills an empty buffer first, and says so.

    There are two files in turn, ``buffer.pt`` and ``buffer-2.pt``: until a checkpoint is written whole, the one before
    has its own.
    """

    def __init__(self, buffer: Replay, path: Path, save: bool) -> None:
        self.buffer, self.path, self.save = buffer, path, save

    def state_dict(self) -> dict[str, Any]:
        """The number of frames and the file's name; writes the file."""
        state = {"written": self.buffer.written, "saved": self.save, "generator": self.buffer.generator.get_state()}
        if self.save:
            self._other()
            save(self.buffer, self.path)
            state["file"] = self.path.name
        return state

    def _other(self) -> None:
        first = self.path.with_stem(self.path.stem.removesuffix("-2"))
        self.path = first.with_stem(first.stem + "-2") if self.path == first and first.exists() else first

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Reads the file that belongs to the checkpoint, if there is one."""
        self.path = self.path.with_name(state.get("file", self.path.name))
        if state["saved"] and self.save and self.path.is_file():
            load(self.buffer, self.path)
            if self.buffer.written == state["written"]:
                return
            self.buffer.clear()
        self.buffer.generator.set_state(state["generator"])
        why = "its file is of another checkpoint" if state["saved"] and self.save else "it was not saved"
        _log.warning(
            "resumed without the replay buffer (%s): it fills again before training goes on; --save-buffer keeps it",
            why,
        )
