"""When to compile."""

from __future__ import annotations

import shutil
from logging import getLogger


def worth_compiling(compile: str, calls: float | None, least_calls: float) -> bool:
    """Whether to compile, by the user's choice ``auto``, ``on`` or ``off``.

    Args:
        compile: ``auto`` compiles where there is a C++ compiler and enough calls are expected.
        calls: expected number of calls; None: not known, and taken to be enough.
        least_calls: number of calls that win the compile time back.
    """
    if compile not in ("auto", "on", "off"):
        raise ValueError(f"compile is 'auto', 'on' or 'off', not {compile!r}")
    if compile != "auto":
        return compile == "on"
    if shutil.which("g++") is None and shutil.which("clang++") is None:
        getLogger("pgkit").warning("no C++ compiler (g++) found: running without torch.compile, about 3 times slower")
        return False
    return calls is None or calls >= least_calls
