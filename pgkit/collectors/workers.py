"""Processes that each hold some environments and the policy, and collect their share of every rollout alone."""

from __future__ import annotations

import copy
import signal
import sys
import traceback
import weakref
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import torch
import torch.multiprocessing as mp
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec

from pgkit.collectors.policy import random_actions, trace
from pgkit.collectors.stepping import Arrays, allocate, fill
from pgkit.compiled import Mode
from pgkit.envs import ArrayEnv, VectorEnv
from pgkit.errors import UserError


class WorkerEnded(RuntimeError):
    """A process is gone without an answer."""


class Workers:
    """Processes that share some of the environments; :meth:`begin` and :meth:`finish` make one rollout's arrays.

    The rollout and the policy's weights are in shared memory: a rollout costs two messages a process.

    Args:
        env: all the environments.
        actor: the policy.
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
        outputs: dict[NestedKey, Tensor],
        compile: Mode,
        bounds: Sequence[int] | None = None,
    ) -> None:
        self._actor = copy.deepcopy(actor).requires_grad_(False).share_memory()
        obs = np.zeros((env.num_envs, *env.observation_shape), np.float32)
        shared = {k: torch.from_numpy(x).share_memory_() for k, x in allocate(steps, obs, outputs).items()}
        self._arrays: Arrays = {key: tensor.numpy() for key, tensor in shared.items()}
        context = _context()
        self._bounds = list(bounds or shares(env))
        self.pipes: list[Connection] = []
        processes = []
        for first, end in pairwise(self._bounds):
            ours, theirs = context.Pipe()
            share = _Share(
                cloudpickle.dumps(env.make_env), first, end - first, env.num_envs, env.seed, env.action_spec,
                self._actor, outputs, shared, compile, env.split,
            )  # fmt: skip
            process = context.Process(target=_serve, args=(theirs, share), daemon=True)
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

    def begin(self, weights: Iterable[Tensor], seed: int, random: bool = False) -> None:
        """Starts a rollout with these weights, the values of the actor's ``state_dict()``."""
        self._answers()  # of a rollout that was interrupted (Ctrl-C in a notebook) or is not wanted any more
        with torch.no_grad():
            for mine, theirs in zip(self._actor.state_dict().values(), weights, strict=True):
                mine.copy_(theirs)
        self._send([("collect", (seed, random))] * len(self.pipes))

    def ready(self) -> bool:
        """Whether :meth:`finish` would not wait."""
        return all(pipe.poll() for pipe in self.pipes)

    def finish(self) -> Arrays:
        """The rollout's arrays ``[T, N, ...]`` of this object's environments, the caller's to keep."""
        self._answers()
        return {key: array[:, self._bounds[0] : self._bounds[-1]].copy() for key, array in self._arrays.items()}

    def state_dict(self) -> dict[str, Any]:
        """The environments' state, as one :class:`~pgkit.envs.ArrayEnv` would give it."""
        parts = self._ask([("state", None)] * len(self.pipes))
        history = [x for part in parts for x in part["history"]]
        episode = [x for part in parts for x in part["episode"]]
        state = {"seed": parts[0]["seed"], "episode": episode, "history": history}
        return state | {"memory": np.concatenate([part["memory"] for part in parts])} if "memory" in parts[0] else state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Gives every process its share of :meth:`state_dict`."""
        start = self._bounds[0]
        cuts = [slice(a - start, b - start) for a, b in pairwise(self._bounds)]
        keys = [key for key in ("episode", "history", "memory") if key in state]
        parts = [{"seed": state["seed"], **{key: state[key][c] for key in keys}} for c in cuts]
        self._ask([("load", part) for part in parts])

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


class _Share(NamedTuple):
    """What a worker is given."""

    make_env: bytes
    first: int
    count: int
    num_envs: int
    seed: int
    action_spec: TensorSpec
    actor: TensorDictModuleBase
    outputs: dict[NestedKey, Tensor]
    shared: dict[NestedKey, Tensor]
    compile: Mode
    split: Callable[[Tensor], dict[str, Tensor]]


def _serve(pipe: Connection, share: _Share) -> None:
    """A worker's life: answers ``(answer, failure)`` to every request until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    try:
        torch.set_num_threads(1)
        envs = ArrayEnv(cloudpickle.loads(share.make_env), share.count, share.seed, share.first)
        act = trace(share.actor, torch.zeros(share.num_envs, *envs.obs.shape[1:]), share.compile, share.split)
        random_act = random_actions(share.action_spec, share.outputs, share.split)
        arrays = {key: tensor.numpy() for key, tensor in share.shared.items()}
        pipe.send((None, None))
        while True:
            request, argument = pipe.recv()
            answer = None
            if request == "collect":
                seed, random = argument
                fill(arrays, envs, random_act if random else act, list(share.outputs), share.num_envs, seed)
            elif request == "state":
                answer = envs.state_dict()
            else:
                envs.load_state_dict(argument)
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
