"""The life of a process that collects: what it answers, what it does not hear, and how it ends."""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from multiprocessing import parent_process, resource_tracker
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import cloudpickle
import torch
from tensordict.nn import TensorDictModuleBase

from pgkit.collectors.stepping import Share
from pgkit.compiled import Mode, load_matmul_state
from pgkit.errors import EnvironmentFailed, UserError
from pgkit.seams import Entries

Request = tuple[str, Any]
STOPS = [s for s in signal.Signals if s.name in ("SIGINT", "SIGTERM", "SIGHUP")]
"""The signals that end a run. They come to a whole process group, or to every process of a job."""


class Order(NamedTuple):
    """What a process is given; ``temporary`` is its parent's folder for sockets."""

    make: bytes
    first: int
    count: int
    num_envs: int
    seed: int
    actor: TensorDictModuleBase
    outputs: Entries
    buffers: Entries
    compile: Mode
    matmul: dict[str, Any]
    temporary: str


def serve(pipe: Connection, order: Order) -> None:
    """Answers ``(answer, failure)`` to every request until the pipe closes."""
    for number in STOPS:  # the parent's to handle; a handler, as a subprocess inherits what is ignored
        signal.signal(number, _leave_to_the_parent)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
    threading.Thread(target=_end_with_the_parent, args=(order.temporary,), daemon=True).start()
    with contextlib.suppress(EOFError, ConnectionError):
        try:
            _answer(pipe, order)
        except (UserError, EnvironmentFailed) as error:
            pipe.send((None, error))
        except (Exception, SystemExit) as error:
            if not isinstance(error, EOFError | ConnectionError):
                pipe.send((None, traceback.format_exc()))


def _answer(pipe: Connection, order: Order) -> None:
    torch.set_num_threads(1)
    load_matmul_state(order.matmul)
    simulator = cloudpickle.loads(order.make)(order.first, order.count, order.seed)
    with contextlib.closing(simulator):
        share = Share(
            simulator, order.first, order.num_envs, order.seed, order.actor, order.outputs, order.buffers, order.compile
        )
        pipe.send((None, None))
        while True:
            request, argument = pipe.recv()
            tells = request == "state"
            if request == "collect":
                step, random, tells = argument
                share.collect(step, random)
            elif request == "load":
                share.load_state_dict(pickle.loads(argument))
            elif request == "rebuild":
                share.rebuild(pickle.loads(argument))
            pipe.send((pickle.dumps(share.state_dict()) if tells else None, None))


def _leave_to_the_parent(*_: Any) -> None: ...


def _end_with_the_parent(temporary: str) -> None:
    """Ends this process when its parent is gone, in the middle of a step, too."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    shutil.rmtree(temporary, ignore_errors=True)  # which a parent that was killed leaves behind
    os._exit(1)


@contextlib.contextmanager
def spared() -> Iterator[None]:
    """Processes that start in this block do not hear the signals that end a run, from their first moment on."""
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    try:
        resource_tracker.ensure_running()  # which unblocks two of them as it starts
        signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def how_it_ended(process: Any) -> str:
    """How a process ended, in words."""
    process.join(timeout=1)
    code = process.exitcode
    if code is None:
        return "does not answer"
    if code < 0:
        memory = " (out of memory?)" if -code == signal.SIGKILL else ""
        return f"was ended by {signal.Signals(-code).name}{memory}"
    return f"ended itself with exit code {code}: something in it called os._exit, or it crashed"


def stop(pipes: list[Connection], processes: list[Any]) -> None:
    """Ends the processes: they may finish for 5 seconds."""
    for pipe in pipes:
        pipe.close()
    end = time.monotonic() + 5
    for process in processes:
        process.join(timeout=max(0.0, end - time.monotonic()))
        if process.is_alive():
            process.kill()
            process.join()
