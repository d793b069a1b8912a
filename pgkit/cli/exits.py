"""How a command ends: the exit codes of exceptions, and what is printed of them."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator
from types import TracebackType

from pgkit.errors import Diverged, EnvironmentFailed, UserError, frames_of


@contextlib.contextmanager
def exits() -> Iterator[None]:
    """Exits with 2 on a ``UserError``, 3 on ``Diverged``, 130 on Ctrl-C; any text fits any terminal.

    Every other exception passes, and is printed by :func:`report`.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    sys.excepthook = report
    try:
        yield
    except (UserError, Diverged) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2 if isinstance(error, UserError) else 3)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # of `pgkit ... | head`; nothing more can be printed, at the interpreter's end neither
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(141)
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        print(f"error: {error.filename}: the name is too long, give a shorter one", file=sys.stderr)
        sys.exit(2)


def report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Prints an exception as one line, and below it where in the user's own code it was raised, or else everything."""
    if isinstance(error, EnvironmentFailed):
        print(f"error: {error.line}\n{error.frames}", end="", file=sys.stderr)
        return
    text = " ".join(str(error).split()) or "no message"
    print(f"error: {kind.__name__}: {text}\n{frames_of(trace)}", end="", file=sys.stderr)
