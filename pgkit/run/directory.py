"""A run's directory: which one, whose it is, and what is taken away again."""

from __future__ import annotations

import os
import time
from pathlib import Path

from pgkit.errors import UserError
from pgkit.run.args import RunArgs, free_on_resume
from pgkit.run.config import read_config, saved_args


def choose(args: RunArgs, recipe: str) -> Path:
    """The directory that the settings ask for; a UserError if it already holds a run. Writes nothing.

    What a run of the same settings left behind that ended before its first checkpoint does not count.
    """
    if args.resume_if_possible and args.run_dir is None:
        raise UserError("--resume-if-possible needs a --run-dir to look into")
    if args.resume_if_possible and not args.resume and args.run_dir and can_resume(args.run_dir):
        args.resume = args.run_dir
    if args.resume:
        return run_of(Path(args.resume))
    name = f"{args.env_id.replace('/', '-')[:100]}__{recipe}__{args.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
    path = Path(args.run_dir or Path("runs") / name)
    _check_free(path, args, recipe)
    return path


def _check_free(path: Path, args: RunArgs, recipe: str) -> None:
    """A UserError where the directory holds a run that this one may not take the place of."""
    try:
        if path.exists() and not path.is_dir():
            raise UserError(f"--run-dir {path} is a file; give a directory")
        held = holds_run(path)
    except (OSError, ValueError) as error:  # the latter of names that no file can have
        reason = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"--run-dir {path!s:.80}...: {reason}") from error
    if held and not _can_start_over(path, args, recipe):
        go_on = (
            f"go on with it by --resume {path}" if can_resume(path) else "delete it: it has no checkpoint to go on from"
        )
        raise UserError(f"{path} already holds a run: give another --run-dir, or {go_on}")


def claim(path: Path, args: RunArgs, recipe: str) -> int | None:
    """Makes the directory and takes it for a new run, as :func:`lock`; what a run left that saved nothing goes."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--run-dir {path} cannot be made: {error.strerror}") from error
    handle = lock(path)
    try:
        _check_free(path, args, recipe)  # again: another run may have come first
        clear(path)
    except BaseException:
        unlock(handle)
        raise
    return handle


def run_of(path: Path) -> Path:
    """The run directory of ``--resume``, which takes one of its checkpoints, too."""
    return path.parent.parent if path.suffix == ".pt" and path.parent.name == "checkpoints" else path


def can_resume(path: Path) -> bool:
    """Whether a checkpoint is there to go on from."""
    return (path / "checkpoints" / "latest.pt").exists()


def holds_run(path: Path) -> bool:
    """Whether anything that a run writes is there."""
    return any((path / name).exists() for name in ("config.json", "metrics.csv", "checkpoints"))


def _can_start_over(path: Path, args: RunArgs, recipe: str) -> bool:
    """Whether the directory holds a run of this recipe and these settings that has saved nothing."""
    if any((path / "checkpoints").glob("*.pt")) or not (path / "config.json").exists():
        return False
    if read_config(path).get("file") is None and read_config(path)["recipe"] != recipe:
        return False
    saved, free = saved_args(type(args), path), {*free_on_resume(type(args)), "run_dir"}
    return all(value == vars(args)[name] for name, value in vars(saved).items() if name not in free)


def lock(path: Path) -> int | None:
    """Takes the directory for this process until :func:`unlock`; a UserError if another has it. None on Windows."""
    try:
        import fcntl
    except ImportError:
        return None
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise UserError(f"{path} is not a run directory: {error.strerror}") from error
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


def clear(path: Path) -> None:
    """Removes what the run there made before its first checkpoint, and no file of anyone else."""
    if not (path / "config.json").exists():
        return
    events = path.glob(f"events.out.tfevents.*.{read_config(path).get('id', '?')}")
    for file in [path / "config.json", path / "metrics.csv", *events]:
        file.unlink(missing_ok=True)


def remove_if_bare(path: Path) -> None:
    """Removes what a run wrote that ended before its first row, and the directory if nothing else is in it."""
    if not path.is_dir() or (path / "metrics.csv").exists() or (path / "checkpoints").exists():
        return
    clear(path)
    if not any(path.iterdir()):
        path.rmdir()
