"""Processes that each hold some environments and the policy, and collect their share of every rollout alone."""

from __future__ import annotations

import copy
import signal
import sys
import traceback
import weakref
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Protocol

import cloudpickle
import torch
import torch.multiprocessing as mp
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pgkit.collectors.stepping import Share, allocate, regroup
from pgkit.compiled import Mode, load_matmul_state, matmul_state
from pgkit.envs import VectorEnv
from pgkit.errors import UserError
from pgkit.seams import Entries


class Pool(Protocol):
    """Processes that share environments, wherever they are: :meth:`begin`, then :meth:`finish`."""

    def begin(self, weights: Iterable[Tensor], step: int, random: bool = False) -> None: ...

    def ready(self) -> bool: ...

    def wait_any(self, pools: Sequence[Any], /) -> None: ...

    @staticmethod
    def wait_any(pools: Sequence[Workers]) -> None:
        """Waits until one of these has something to say."""
        wait([pipe for workers in pools for pipe in workers.pipes])

    def finish(self) -> Entries: ...

    def state_dict(self) -> list[dict[str, Any]]: ...

    def load_state_dict(self, states: list[dict[str, Any]], /) -> None: ...

    def close(self) -> Any: ...


MakePool = Callable[..., Pool]


class WorkerEnded(RuntimeError):
    """A process is gone without an answer."""


class Workers:
    """Processes that share some of the environments; :meth:`begin` and :meth:`finish` make one rollout's buffers.

    The rollout and the policy's weights are in shared memory: a rollout costs two messages a process. Each process
    evaluates the policy on its own rows only.

    Args:
        env: all the environments.
        actor: the policy, on the CPU.
        steps: steps each environment takes for a rollout.
        outputs: examples of what the policy writes.
        compile: compile the policy.
        bounds: the environments ``bounds[i]`` to ``bounds[i + 1]`` are process i's; None: all, evenly.
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
        self._actor = copy.deepcopy(actor).requires_grad_(False).share_memory()
        self._buffers = {key: x.share_memory_() for key, x in allocate(steps, env, outputs).items()}
        context = _context()
        self._bounds = list(bounds or shares(env))
        self.pipes: list[Connection] = []
        processes = []
        for first, end in pairwise(self._bounds):
            ours, theirs = context.Pipe()
            columns = {key: x[:, first:end] for key, x in self._buffers.items()}
            order = _Order(
                cloudpickle.dumps(env.make), first, end - first, env.num_envs, env.seed, self._actor, outputs, columns,
                compile, matmul_state(),
            )  # fmt: skip
            process = context.Process(target=_serve, args=(theirs, order), daemon=True)
            process.start()
            theirs.close()
            self.pipes.append(ours)
            processes.append(process)
        self.close = weakref.finalize(self, _stop, self.pipes, processes)
        self._asked = [True] * len(self.pipes)  # whose answer is not read yet: the first one says that it is up
        try:
            self._answers()  # the processes are up
        except WorkerEnded as error:
            raise UserError(
                "a collector worker ended before it began: what starts workers in a script belongs inside "
                "`if __name__ == '__main__':`, as every worker imports the script; the lines above may tell more"
            ) from error

    def begin(self, weights: Iterable[Tensor], step: int, random: bool = False) -> None:
        """Starts a rollout with these weights, the values of the actor's ``state_dict()``; as :meth:`Share.collect`."""
        self._answers()  # of a rollout that was interrupted (Ctrl-C in a notebook) or is not wanted any more
        with torch.no_grad():
            for mine, theirs in zip(self._actor.state_dict().values(), weights, strict=True):
                mine.copy_(theirs)
        self._send([("collect", (step, random))] * len(self.pipes))

    def ready(self) -> bool:
        """Whether :meth:`finish` would not wait."""
        return all(pipe.poll() for pipe in self.pipes)

    @staticmethod
    def wait_any(pools: Sequence[Workers]) -> None:
        """Waits until one of these has something to say."""
        wait([pipe for workers in pools for pipe in workers.pipes])

    def finish(self) -> Entries:
        """The rollout's buffers ``[T, N, ...]`` of this object's environments, the caller's to keep."""
        self._answers()
        return {key: x[:, self._bounds[0] : self._bounds[-1]].clone() for key, x in self._buffers.items()}

    def state_dict(self) -> list[dict[str, Any]]:
        """The state of every process's share."""
        return self._ask([("state", None)] * len(self.pipes))

    def load_state_dict(self, states: list[dict[str, Any]]) -> None:
        """Gives every process its share of :meth:`state_dict`, taken with any number of processes."""
        self._ask([("load", state) for state in regroup(states, self._bounds)])

    def _ask(self, requests: list[Any]) -> list[Any]:
        self._answers()
        self._send(requests)
        return self._answers()

    def _send(self, requests: list[Any]) -> None:
        for i, (pipe, request) in enumerate(zip(self.pipes, requests, strict=True)):
            self._asked[i] = True
            pipe.send(request)

    def _answers(self) -> list[Any]:
        """Waits for the answer of every process that was asked, and returns them."""
        answers = []
        for i, pipe in enumerate(self.pipes):
            if not self._asked[i]:
                continue
            try:
                answer, failure = pipe.recv()
                self._asked[i] = False
            except (EOFError, ConnectionError):
                self.close()
                raise WorkerEnded(f"collector worker {i} ended (killed, or out of memory)") from None
            if isinstance(failure, UserError):
                self.close()
                raise failure
            if failure:
                self.close()
                raise RuntimeError(f"collector worker {i} failed:\n{failure}")
            answers.append(answer)
        return answers


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


class _Order(NamedTuple):
    """What a worker is given."""

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


def _serve(pipe: Connection, order: _Order) -> None:
    """A worker's life: answers ``(answer, failure)`` to every request until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    try:
        torch.set_num_threads(1)
        load_matmul_state(order.matmul)
        simulator = cloudpickle.loads(order.make)(order.first, order.count, order.seed)
        share = Share(
            simulator, order.first, order.num_envs, order.seed, order.actor, order.outputs, order.buffers, order.compile
        )
        pipe.send((None, None))
        while True:
            request, argument = pipe.recv()
            answer = None
            if request == "collect":
                share.collect(*argument)
            elif request == "state":
                answer = share.state_dict()
            else:
                share.load_state_dict(argument)
            pipe.send((answer, None))
    except (EOFError, ConnectionError):
        pass
    except UserError as error:
        pipe.send((None, error))
    except Exception:
        pipe.send((None, traceback.format_exc()))


def _stop(pipes: list[Connection], processes: list[Any]) -> None:
    for pipe in pipes:
        pipe.close()
    for process in processes:
        process.join(timeout=5)
        if process.is_alive():
            process.kill()
