"""Joining a Ray cluster, or starting one on this machine, and waiting for a place in it."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from logging import getLogger
from types import ModuleType
from typing import Any, NoReturn

from pgkit.errors import EnvironmentFailed, UserError

MOST_DEATHS = 3  # of one process at one request
_SAID_EVERY = 10.0  # seconds
_ONE_NODE = {"health_check_failure_threshold": 1_000_000}  # a machine that slept an hour is not a dead node


def ray_module() -> ModuleType:
    """The package ``ray``.

    Raises:
        UserError: it is not installed.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise UserError('this needs Ray: pip install "pgkit-rl[ray]"') from None
    return ray


def connect(address: str | None = None, cpus: int = 1) -> None:
    """Joins the cluster at ``address`` (or ``RAY_ADDRESS``); without one, starts Ray on this machine.

    What it starts has room for ``cpus`` processes, also where the machine has fewer cores, and ends with this process.
    A cluster that this process has joined already stays as it is.

    Raises:
        UserError: there is no cluster at the address.
    """
    ray = ray_module()
    address = address or os.environ.get("RAY_ADDRESS")
    if ray.is_initialized():
        return
    quiet: Any = {"log_to_driver": False, "logging_level": "ERROR"}
    if address:
        try:
            ray.init(address=address, **quiet)
        except ConnectionError as error:
            raise UserError(
                f"--ray-address {address}: no Ray cluster answers there; start one with: ray start --head"
            ) from error
        except ValueError as error:
            raise UserError(f"--ray-address {address}: give auto, HOST:6379 or ray://HOST:10001") from error
        return
    os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's own 15 lets everything else on the machine go first
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    places = max(cpus, os.cpu_count() or 1)
    ray.init(address="local", num_cpus=places, include_dashboard=False, _system_config=_ONE_NODE, **quiet)


def failed(error: Any, who: str) -> NoReturn:
    """Raises what a process raised, from Ray's ``RayTaskError``: as it is where one line explains it."""
    if isinstance(error.cause, UserError | EnvironmentFailed):
        raise error.cause from None
    raise RuntimeError(f"{who} failed:\n{error.traceback_str}") from None


class Waiting:
    """Waits for processes to find a place in the cluster; says every ten seconds what for, up to a time limit.

    Args:
        what: the name of such a process.
        limit: seconds from the first look at which one is missing.
    """

    def __init__(self, what: str, limit: float) -> None:
        self._what, self._limit = what, limit
        self._since: float | None = None

    def go_on(self, refs: Sequence[Any], timeout: float) -> bool:
        """Waits ``timeout`` seconds at most; whether all are there.

        Raises:
            UserError: they were waited for longer than the limit.
        """
        ray = ray_module()
        missing = ray.wait(list(refs), num_returns=len(refs), timeout=timeout)[1] if refs else []
        now = time.monotonic()
        if not missing:
            self._since = None
            return True
        if self._since is None:
            self._since = self._said = now
        if now - self._since > self._limit:
            raise UserError(f"{self._shortage(len(missing), len(refs))}: waited {self._limit:.0f} s for it")
        if now - self._said > _SAID_EVERY:
            self._said = now
            getLogger("pgkit").warning("%s: waiting for it", self._shortage(len(missing), len(refs)))
        return False

    def _shortage(self, missing: int, wanted: int) -> str:
        ray = ray_module()
        free, all_of_it = (x.get("CPU", 0) for x in (ray.available_resources(), ray.cluster_resources()))
        nodes = sum(node["Alive"] for node in ray.nodes())
        return (
            f"{missing} of {wanted} {self._what} have no place yet: each needs 1 CPU, the cluster of {nodes} nodes has "
            f"{free:g} of {all_of_it:g} free"
        )
