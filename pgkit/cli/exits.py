"""How a command ends: the exit codes of exceptions, and what is printed of them."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from pgkit.errors import Diverged, UserError

PGKIT = str(Path(__file__).parents[1])
OTHERS = tuple(path for path in sys.path if path.endswith("-packages"))


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
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, UserError) else 3)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # of `pgkit ... | head`; nothing more can be printed, at the interpreter's end neither
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(141)


def report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Prints an exception as one line, and below it where in the user's own code it was raised, or else everything."""
    frames = traceback.extract_tb(trace)
    pgkit = [number for number, frame in enumerate(frames) if frame.filename.startswith(PGKIT)]
    own = [frame for frame in frames if frame.line and not frame.filename.startswith((PGKIT, *OTHERS, "<frozen"))]
    raised_there = own and (not pgkit or frames.index(own[-1]) > pgkit[-1])
    text = " ".join(str(error).split()) or "no message"
    print(f"error: {kind.__name__}: {text}", file=sys.stderr)
    print("".join(traceback.format_list(own if raised_there else frames)), end="", file=sys.stderr)
