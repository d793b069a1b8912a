"""Processes that each hold some environments and the policy, and collect their share of every rollout alone."""

from __future__ import annotations

import contextlib
import copy
import pickle
import sys
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from logging import getLogger
from multiprocessing.connection import Connection, wait
from multiprocessing.util import Finalize, get_temp_dir
from typing import Any, Protocol

import cloudpickle
import torch
import torch.multiprocessing as mp
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pgkit.collectors.rebuild import Known
from pgkit.collectors.serving import Order, Request, how_it_ended, serve, spared, stop
from pgkit.collectors.stepping import allocate, lost, regroup
from pgkit.compiled import Mode, matmul_state
from pgkit.envs import VectorEnv
from pgkit.errors import EnvironmentFailed, EnvironmentHung, UserError
from pgkit.seams import Entries, Key

STEPS: Key = ("next", "step_count")
_START: Request = ("start", None)


class Pool(Protocol):
    """Processes that share environments, wherever they are: :meth:`begin`, then :meth:`finish`."""

    def begin(self, weights: Iterable[Tensor], step: int, random: bool = False) -> None: ...

    @property
    def is_open(self) -> bool: ...

    def ready(self) -> bool: ...

    def wait_any(self, pools: Sequence[Any], /) -> bool: ...

    def finish(self) -> Entries: ...

    def state_dict(self) -> list[dict[str, Any]]: ...

    def load_state_dict(self, states: list[dict[str, Any]], /) -> None: ...

    def close(self) -> Any: ...


MakePool = Callable[..., Pool]


class WorkerEnded(EnvironmentFailed):
    """A process is gone without an answer, or does not answer."""


class Workers:
    """Processes that share some of the environments; :meth:`begin` and :meth:`finish` make one rollout's buffers.

    The rollout and the policy's weights are in shared memory: a rollout costs two messages a process. Each process
    evaluates the policy on its own rows only.

    With ``env.restart_workers``, a process that has ended or hangs is replaced: the new one takes the actions again
    that were taken until the last rollout (:class:`Known`), and collects this one again, to the same numbers. Where it
    ends again, its environments begin new episodes; the third time is an error.

    Args:
        env: all the environments.
        actor: the policy, on the CPU.
        steps: steps each environment takes for a rollout.
        outputs: examples of what the policy writes.
        compile: compile the policy.
        bounds: the environments ``bounds[i]`` to ``bounds[i + 1]`` are process i's; None: all, evenly.

    Attributes:
        episodes_lost: episodes that the replaced processes did not go on with.
    """

    def __init__(
        self,
        env: VectorEnv,
        actor: TensorDictModuleBase,
        steps: int,
        outputs: Entries,
        compile: Mode,
        bounds: Sequence[int] | None = None,
    ) -> None:
        try:
            self._actor = copy.deepcopy(actor).requires_grad_(False).share_memory()
            self._buffers = {key: x.share_memory_() for key, x in allocate(steps, env, outputs).items()}
        except RuntimeError as error:
            raise UserError(f"the workers' rollouts need shared memory: {str(error).splitlines()[0]}") from error
        self._env, self._bounds, self._step, self.episodes_lost = env, list(bounds or shares(env)), 0, 0
        make = cloudpickle.dumps(env.make)
        self._orders = [
            Order(
                make, first, end - first, env.num_envs, env.seed, self._actor, outputs,
                {key: x[:, first:end] for key, x in self._buffers.items()}, compile, matmul_state(),
                get_temp_dir(),
            )
            for first, end in pairwise(self._bounds)
        ]  # fmt: skip
        self.pipes: list[Connection] = []
        self._processes: list[Any] = []
        # at the interpreter's end before multiprocessing waits for its processes, which do not heed its SIGTERM
        self.close = Finalize(self, stop, (self.pipes, self._processes), exitpriority=10)
        self._asked: list[Request | None] = [None] * len(self._orders)  # whose answer is not read yet
        pasts = pairwise(self._bounds) if env.restart_workers else ()
        self._known = [Known(env, end - first, outputs) for first, end in pasts]  # where processes are replaced
        try:
            for i in range(len(self._orders)):
                self._start(i)
            self._answers()  # the processes are up
        except OSError as error:
            raise UserError(
                f"{len(self._orders)} worker processes cannot be started: {error.strerror}; give fewer --workers, or "
                "raise the limit (ulimit)"
            ) from error
        except WorkerEnded as error:
            raise UserError(
                "a collector worker ended before it began: what starts workers in a script belongs inside "
                "`if __name__ == '__main__':`, as every worker imports the script; the lines above may tell more"
            ) from error

    def _start(self, i: int) -> None:
        """Starts process i, which says first that it is up."""
        ours, theirs = _context().Pipe()
        self.pipes[i : i + 1] = [ours]
        with spared():
            process = _context().Process(target=serve, args=(theirs, self._orders[i]), daemon=True)
            process.start()
            self._processes[i : i + 1] = [process]
        theirs.close()
        self._asked[i] = _START

    @property
    def is_open(self) -> bool:
        """Whether the processes run: any failure ends them all."""
        return self.close.still_active()

    def begin(self, weights: Iterable[Tensor], step: int, random: bool = False) -> None:
        """Starts a rollout with these weights, the values of the actor's ``state_dict()``; as :meth:`Share.collect`."""
        self._answers()  # of a rollout that was interrupted (Ctrl-C in a notebook) or is not wanted any more
        with torch.no_grad():
            for mine, theirs in zip(self._actor.state_dict().values(), weights, strict=True):
                mine.copy_(theirs)
        if self._env.env_timeout is not None:
            self._buffers[STEPS].fill_(-1)  # shows how far a process has come
        self._step = step
        for i in range(len(self.pipes)):
            tells = bool(self._known) and self._known[i].asks()
            self._send(i, ("collect", (step, random, tells)))

    def ready(self) -> bool:
        """Whether :meth:`finish` would not wait."""
        return all(pipe.poll() for pipe in self.pipes)

    def wait_any(self, pools: Sequence[Workers]) -> bool:
        """Waits until one of these has something to say; False: none has within the time that a step may take."""
        return bool(wait([pipe for workers in pools for pipe in workers.pipes], self._env.env_timeout))

    def finish(self) -> Entries:
        """The rollout's buffers ``[T, N, ...]`` of this object's environments, the caller's to keep."""
        self._answers()
        return {key: x[:, self._bounds[0] : self._bounds[-1]].clone() for key, x in self._buffers.items()}

    def state_dict(self) -> list[dict[str, Any]]:
        """The state of every process's share."""
        states = self._ask([("state", None)] * len(self.pipes))
        self._tell(states)
        return [pickle.loads(state) for state in states]

    def load_state_dict(self, states: list[dict[str, Any]]) -> None:
        """Gives every process its share of :meth:`state_dict`, taken with any number of processes."""
        parts = [pickle.dumps(state) for state in regroup(states, self._bounds)]
        self._tell(parts)
        self._ask([("load", state) for state in parts])

    def _tell(self, states: list[bytes]) -> None:
        for known, state in zip(self._known, states, strict=False):
            known.told(state)

    def _ask(self, requests: list[Request]) -> list[Any]:
        self._answers()
        for i, request in enumerate(requests):
            self._send(i, request)
        return self._answers()

    def _send(self, i: int, request: Request) -> None:
        self._asked[i] = request
        with contextlib.suppress(ConnectionError):  # it is gone, as its answer will show
            self.pipes[i].send(request)

    def _answers(self) -> list[Any]:
        """Waits for the answer of every process that was asked, and returns them."""
        try:
            return [self._answer(i) for i, asked in enumerate(self._asked) if asked is not None]
        except Exception:
            self.close()
            raise

    def _answer(self, i: int) -> Any:
        """The answer of process i, or of the one that takes its place."""
        asked = self._asked[i]
        assert asked is not None
        replaces = self._env.restart_workers and asked != _START
        ended: WorkerEnded | None = None
        for chance in range(3 if replaces else 1):
            try:
                if ended is not None:
                    self._replace(i, ended, asked, anew=chance == 2)
                return self._receive(i)
            except WorkerEnded as error:
                ended = error
        assert ended is not None
        raise ended

    def _receive(self, i: int) -> Any:
        try:
            self._wait(i)
            answer, failure = self.pipes[i].recv()
        except (EOFError, ConnectionError):
            raise WorkerEnded(f"{self._name(i)} {how_it_ended(self._processes[i])}") from None
        if isinstance(failure, EnvironmentHung) and self._env.restart_workers:
            raise WorkerEnded(failure.line, failure.frames)
        if isinstance(failure, str):
            raise RuntimeError(f"collector worker {i} failed:\n{failure}")
        if failure is not None:
            raise failure
        if self._collects(i) and self._known:
            self._known[i].collected(self._orders[i].buffers, answer)
        self._asked[i] = None
        return answer

    def _wait(self, i: int) -> None:
        """Waits for an answer; ``WorkerEnded`` where a process makes no step for longer than a step may take."""
        limit, before = self._env.env_timeout, -1
        while limit is not None and not self.pipes[i].poll(2 * limit):  # it should have said so itself by now
            made = int((self._buffers[STEPS][:, self._bounds[i]] >= 0).sum())
            if made == before and self._collects(i):
                raise WorkerEnded(f"{self._name(i)} has made no step for {2 * limit:g} s (--env-timeout {limit:g})")
            before = made

    def _replace(self, i: int, ended: WorkerEnded, asked: Request, anew: bool) -> None:
        """Starts a process in place of one that is gone, brings its environments back, and asks again."""
        first, end = self._bounds[i : i + 2]
        anew |= self._env.resume != "exact"
        self.episodes_lost += (end - first) * anew
        getLogger("pgkit").warning(
            "%s; a new process takes its place: its environments %s", ended.line,
            f"begin new episodes ({self.episodes_lost:,} lost so far)" if anew else "go on where they were",
        )  # fmt: skip
        if anew:
            self._known[i].told(pickle.dumps(lost(self._step)))
        self._processes[i].kill()
        self.pipes[i].close()
        self._start(i)
        for request in (("rebuild", pickle.dumps(self._known[i].past)), asked):
            self._receive(i)
            self._send(i, request)

    def _collects(self, i: int) -> bool:
        asked = self._asked[i]
        return asked is not None and asked[0] == "collect"

    def _name(self, i: int) -> str:
        first, end = self._bounds[i : i + 2]
        return (
            f"collector worker {i} (environments {first} to {end - 1} of {self._env.env_id}, seed {self._env.seed}), "
            f"in the rollout from step {self._step:,} on,"
        )


def _context() -> Any:
    """How processes start: on Linux by a fork of a server that has imported pgkit once, 5 seconds sooner each."""
    if sys.platform != "linux":
        return mp.get_context("spawn")
    context = mp.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context


def shares(env: VectorEnv) -> list[int]:
    """Where each worker's environments begin, and the end."""
    return [round(i * env.num_envs / env.workers) for i in range(env.workers + 1)]


def check_splits(env: VectorEnv) -> None:
    """A ``UserError`` for environments that other processes cannot make or share memory with."""
    if env.device is not None and env.device.type != "cpu":
        raise UserError(f"workers={env.workers} with environments on {env.device}: one process steps them, workers=1")
    if not env.splits:
        raise UserError(
            f"the {env.env_id} given is in this process, workers make their own: give envs.make a function that "
            "makes one, or use collectors.VectorCollector with workers=1"
        )
