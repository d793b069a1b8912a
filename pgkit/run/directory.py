"""A run's directory and its ``config.json``."""

import dataclasses
import json
import math
import os
import platform
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from pgkit.errors import UserError
from pgkit.run.settings import RunArgs, read_json

PACKAGES = ("pgkit", "torch", "torchrl", "tensordict", "numpy", "gymnasium", "mujoco", "dm-control", "shimmy")


def choose(args: RunArgs, recipe: str) -> Path:
    """The directory that the settings ask for; a UserError if it already holds a run. Writes nothing."""
    if args.resume:
        return Path(args.resume)
    name = f"{args.env_id.replace('/', '-')}__{recipe}__{args.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
    path = Path(args.run_dir or Path("runs") / name)
    if path.exists() and not path.is_dir():
        raise UserError(f"--run-dir {path} is a file; give a directory")
    if holds_run(path):
        saved = (path / "checkpoints" / "latest.pt").exists()
        way = f"or go on with it by --resume {path}" if saved else "or delete it: it has no checkpoint to go on from"
        raise UserError(f"{path} already holds a run: give another --run-dir, {way}")
    return path


def holds_run(path: Path) -> bool:
    """Whether anything that a run writes is there."""
    return any((path / name).exists() for name in ("config.json", "metrics.csv", "checkpoints"))


def write_config(path: Path, args: RunArgs, recipe: str, resumed_at: list[int]) -> None:
    """Write ``config.json``: recipe, resolved settings, versions, git revision, frames at each resume.

    A new run claims the directory by creating the file; if another run got there first this is a UserError.
    """
    config = {
        "recipe": recipe,
        "settings": dataclasses.asdict(args) | {"run_dir": path, "resume": None},
        "command": read_config(path)["command"] if resumed_at else sys.argv,
        "versions": versions(),
        "git_revision": git_revision(),
        "resumed_at": resumed_at,
    }
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--run-dir {path} cannot be made: {error.strerror}") from error
    if not resumed_at:
        try:
            (path / "config.json").touch(exist_ok=False)
        except FileExistsError:
            raise UserError(f"{path} already holds a run: give another --run-dir") from None
    write_json(path / "config.json", config)


def lock(path: Path) -> int | None:
    """Takes the directory for this process until :func:`unlock`; a UserError if another has it. None on Windows."""
    try:
        import fcntl
    except ImportError:
        return None
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise UserError(f"{path}: another process goes on with this run; wait for it, or stop it") from None
    except OSError:  # a file system without locks
        pass
    return handle


def unlock(handle: int | None) -> None:
    """Gives back what :func:`lock` took."""
    if handle is not None:
        os.close(handle)


def remove_if_bare(path: Path) -> None:
    """Removes what a run wrote that ended before its first row, and the directory if nothing else is in it."""
    if not path.is_dir() or (path / "metrics.csv").exists() or (path / "checkpoints").exists():
        return
    for file in [path / "config.json", *path.glob("events.out.tfevents.*")]:
        file.unlink(missing_ok=True)
    if not any(path.iterdir()):
        path.rmdir()


def read_config(path: Path) -> dict[str, Any]:
    """``config.json`` of a run directory; a UserError if there is none."""
    if not (path / "config.json").is_file():
        raise UserError(f"{path} is not a run directory: it has no config.json")
    return read_json(path / "config.json")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON in one step; NaN and infinity, which JSON does not have, become null."""
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in content.items()}
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(json.dumps(plain, indent=2, default=str) + "\n")
    os.replace(temporary, path)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that can change a run's numbers."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {**found, "torch": str(torch.__version__)}  # with its build (+cpu, +cu130), which a wheel may not name


def git_revision() -> str | None:
    """Revision of the working directory, ``-dirty`` with uncommitted changes; None outside a repository."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None
