"""Warnings that are said once, however many environments are made."""

from __future__ import annotations

import multiprocessing
from functools import cache
from logging import getLogger


@cache
def warn_once(message: str) -> None:
    """Logs a warning, unless this process has logged the same one, or is a worker: its parent has."""
    if multiprocessing.parent_process() is None:
        getLogger("pgkit").warning("%s", message)
