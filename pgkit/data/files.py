"""A replay buffer's state, as a dict and as a file of its own."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from logging import getLogger
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl.data import LazyMemmapStorage
from torchrl.data.replay_buffers import TensorStorage

from pgkit import files
from pgkit.errors import UserError

if TYPE_CHECKING:
    from pgkit.data.replay import ReplayBuffer

_log = getLogger("pgkit")


def state(buffer: ReplayBuffer) -> dict[str, Any]:
    """The rows in use, the counters and the generator."""
    frames, finals = min(buffer.written + buffer.columns, buffer.rows), min(buffer.finals, buffer.final_rows)
    return {
        "made_for": _made_for(buffer),
        "counters": (buffer.written, buffer.start, buffer.finals),
        "owner": buffer.owner[:finals].clone(),
        "generator": buffer.generator.get_state(),
        "frames": {key: x[:frames].clone() for key, x in buffer.frames.items()},
        "observations": {key: x[:frames].clone() for key, x in buffer.observations.items()},
        "finals": {key: x[buffer.rows :][:finals].clone() for key, x in buffer.observations.items()},
        "sampler": None if buffer.sampler is None else buffer.sampler.state_dict(),
    }


def restore(buffer: ReplayBuffer, saved: dict[str, Any]) -> None:
    """Loads :func:`state` into a buffer made alike."""
    theirs, mine = saved["made_for"], _made_for(buffer)
    for name, value in mine.items():
        if theirs.get(name) != value:
            raise UserError(
                f"the saved replay buffer is another one: its {name} is {theirs.get(name)}, here it is {value}; "
                "give the same environment and settings, or train without the saved buffer"
            )
    buffer.clear()
    buffer.written, buffer.start, buffer.finals = saved["counters"]
    buffer.owner[: len(saved["owner"])] = saved["owner"]
    buffer.generator.set_state(saved["generator"])
    for key, x in saved["frames"].items():
        buffer.frames[key][: len(x)] = x
    for key, x in saved["observations"].items():
        buffer.observations[key][: len(x)] = x
    for key, x in saved["finals"].items():
        buffer.observations[key][buffer.rows : buffer.rows + len(x)] = x
    if buffer.sampler is not None:
        buffer.sampler.load_state_dict(saved["sampler"])


def save(buffer: ReplayBuffer, path: Path) -> None:
    """Writes the state to ``path``: a crash leaves the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files.save(path, state(buffer))


def load(buffer: ReplayBuffer, path: Path) -> None:
    """Reads what :func:`save` wrote."""
    if not path.is_file():
        raise UserError(f"there is no saved replay buffer at {path}")
    restore(buffer, files.load(path))


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


def _made_for(buffer: ReplayBuffer) -> dict[str, Any]:
    shapes = {str(key): tuple(x.shape[1:]) for key, x in buffer.observations.items()}
    return {
        "environment": buffer.env_name,
        "observation": shapes,
        "action": tuple(buffer.frames["action"].shape[1:]),
        "entries": {key: tuple(buffer.frames[key].shape[1:]) for key in buffer.entries},
        "num_envs": buffer.columns,
        "n_steps": buffer.n_steps,
        "capacity": buffer.capacity,
        "final_rows": buffer.final_rows,
        "prioritized": buffer.sampler is not None,
    }


class BesideCheckpoint:
    """A run's handle on its replay buffer: a checkpoint has its frame count, a file beside it the frames.

    Args:
        buffer: the replay buffer.
        path: its file.
        save: write that file with every checkpoint; otherwise a resumed run fills an empty buffer first, and says so.

    There are two files in turn, ``buffer.pt`` and ``buffer-2.pt``: until a checkpoint is written whole, the one before
    has its own.
    """

    def __init__(self, buffer: ReplayBuffer, path: Path, save: bool) -> None:
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
