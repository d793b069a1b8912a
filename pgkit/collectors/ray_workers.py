"""Ray actors that each hold some environments and the policy: a collector's workers, on any machine of a cluster."""

from __future__ import annotations

import copy
import os
import pickle
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from logging import getLogger
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pgkit.collectors.blocks import Layout
from pgkit.collectors.cluster import MOST_DEATHS, Waiting, failed, ray_module
from pgkit.collectors.rebuild import Known, Past
from pgkit.collectors.stepping import Share, allocate, regroup
from pgkit.collectors.workers import WorkerEnded, shares
from pgkit.compiled import Mode, load_matmul_state, matmul_state
from pgkit.envs import VectorEnv
from pgkit.errors import UserError
from pgkit.seams import Entries, MakeSimulator

_TICK = 0.5  # seconds between looks at what is slow to come


class RayWorkers:
    """What :class:`~pgkit.collectors.workers.Workers` is, of Ray actors: :meth:`begin`, then :meth:`finish`.

    An actor gets the weights as one block of bytes and answers with its share of the rollout as another. One that dies,
    alone or with its node, is made anew wherever there is a place, is brought to where it was (:class:`Known`), and
    collects the same rollout again.

    Args:
        env, actor, steps, outputs, compile, bounds: as of ``Workers``.
        wait: seconds to wait for a place in the cluster.

    Attributes:
        deaths: actors that died so far.
        lost: episodes that were cut short by those deaths.
    """

    def __init__(
        self,
        env: VectorEnv,
        actor: TensorDictModuleBase,
        steps: int,
        outputs: Entries,
        compile: Mode,
        bounds: Sequence[int] | None = None,
        wait: float = 300.0,
    ) -> None:
        ray = ray_module()
        self._ray, self._bounds = ray, list(bounds or shares(env))
        self._count = len(self._bounds) - 1
        self._weights = Layout(actor.state_dict().values())
        buffers, actor = allocate(steps, env, outputs), copy.deepcopy(actor).requires_grad_(False)
        self._keys = list(buffers)
        self._orders, self._layouts = [], []
        for first, end in pairwise(self._bounds):
            layout = Layout(x[:, first:end] for x in buffers.values())
            order = _Order(
                env.make, first, end - first, env.num_envs, env.seed, actor, self._weights, outputs, self._keys,
                layout, compile, matmul_state(),
            )  # fmt: skip
            self._orders.append(ray.put(cloudpickle.dumps(order)))
            self._layouts.append(layout)
        self._remote: Any = ray.remote(RemoteShare).options(num_cpus=1, max_restarts=0)
        self._known = [Known(env, end - first, outputs) for first, end in pairwise(self._bounds)]
        self._waiting = Waiting("collecting processes", wait)
        self._actors, self._there, self._built, self._asked, self._refs, self._answers = _nones(self._count, 6)
        self._deaths = [0] * self._count  # at the present request
        self.deaths = self.lost = 0
        for i in range(self._count):
            self._make(i)
            self._ask(i, "place")
        self._all()

    def places(self) -> list[tuple[str, int]]:
        """Where each actor is: a machine's address, and the number of a process there."""
        return self._ray.get(self._there)

    @property
    def is_open(self) -> bool:
        """Whether the actors are there: any failure but a death ends them all."""
        return bool(self._actors)

    def begin(self, weights: Iterable[Tensor], step: int, random: bool = False) -> None:
        """Starts a rollout with these weights, the values of the actor's ``state_dict()``; as :meth:`Share.collect`."""
        self._all()  # of a rollout that was interrupted or is not wanted any more
        block = self._ray.put(self._weights.pack(weights))
        for i, known in enumerate(self._known):
            self._ask(i, "collect", block, step, random, known.asks())

    def ready(self) -> bool:
        """Whether :meth:`finish` would not wait."""
        return self._receive(timeout=0)

    def wait_any(self, groups: Sequence[RayWorkers]) -> bool:
        """Waits until something of these has come, for a moment at most."""
        pending = [ref for workers in groups for ref in workers._refs if ref is not None]
        self._ray.wait(pending, num_returns=1, timeout=_TICK)
        return True

    def finish(self) -> Entries:
        """The rollout's buffers ``[T, N, ...]`` of this object's environments, the caller's to keep."""
        columns = zip(*self._all(), strict=True)
        return {key: torch.cat(parts, 1) for key, parts in zip(self._keys, columns, strict=True)}

    def state_dict(self) -> list[dict[str, Any]]:
        """The state of every actor's share."""
        self._all()
        for i in range(self._count):
            self._ask(i, "state")
        return [pickle.loads(state) for state in self._all()]

    def load_state_dict(self, states: list[dict[str, Any]]) -> None:
        """Gives every actor its share of :meth:`state_dict`, taken with any number of processes."""
        self._all()
        for i, state in enumerate(regroup(states, self._bounds)):
            self._known[i].told(pickle.dumps(state))
            self._ask(i, "load", self._known[i].past.state)
        self._all()

    def close(self) -> None:
        """Ends the actors."""
        for actor in self._actors:
            self._ray.kill(actor)
        self._actors = []

    def _make(self, i: int) -> None:
        """Makes an actor, where the one before was, and gives it that one's request again."""
        actor = self._actors[i] = self._remote.remote()
        self._there[i] = actor.place.remote()
        self._built[i] = actor.build.remote(sys.path, self._orders[i], self._known[i].past)
        if self._asked[i] is not None:
            self._ask(i, *self._asked[i])

    def _ask(self, i: int, request: str, *arguments: Any) -> None:
        self._asked[i] = (request, *arguments)
        method = getattr(self._actors[i], request)
        self._refs[i] = method.remote(self._built[i], *arguments)  # what fails in building fails here

    def _all(self) -> list[Any]:
        """The answer of every actor to its last request; waits for those that are not there yet."""
        while not self._receive(_TICK):
            pass
        return list(self._answers)

    def _receive(self, timeout: float) -> bool:
        """Takes what comes within so many seconds; whether no answer is missing."""
        pending = {ref: i for i, ref in enumerate(self._refs) if ref is not None}
        if not pending:
            return True
        for ref in self._ray.wait(list(pending), num_returns=len(pending), timeout=timeout)[0]:
            self._take(pending[ref], ref)
        missing = [self._there[i] for i, ref in enumerate(self._refs) if ref is not None]
        try:
            self._waiting.go_on(missing, timeout=0)
        except UserError:
            self.close()
            raise
        return not missing

    def _take(self, i: int, ref: Any) -> None:
        errors = self._ray.exceptions
        gone = (errors.RayActorError, errors.ObjectLostError, errors.NodeDiedError, errors.WorkerCrashedError)
        try:
            self._answers[i] = self._noted(i, self._ray.get(ref))
            self._refs[i], self._asked[i], self._deaths[i] = None, None, 0
        except errors.RayTaskError as error:
            self.close()
            failed(error, f"collecting process {i}")
        except gone as error:
            self._replace(i, str(error))

    def _noted(self, i: int, answer: Any) -> Any:
        """The answer, and for a rollout its tensors; what it says of the environments is remembered."""
        request, known = self._asked[i][0], self._known[i]
        if request == "state":
            known.told(answer)
        if request != "collect":
            return answer
        block, state = answer
        parts = self._layouts[i].unpack(block)
        known.collected(dict(zip(self._keys, parts, strict=True)), state)
        return parts

    def _replace(self, i: int, reason: str) -> None:
        """Makes an actor in the place of one that died."""
        self._ray.kill(self._actors[i])  # alive where only what it sent was lost
        self._deaths[i] += 1
        self.deaths += 1
        lost = self._known[i].lost()
        self.lost += lost
        if self._deaths[i] >= MOST_DEATHS:
            self.close()
            raise WorkerEnded(f"collecting process {i} ended {MOST_DEATHS} times at the same request: {reason}")
        getLogger("pgkit").warning(
            "collecting process %d ended (killed, out of memory, or its node is gone): it is made again, %s",
            i, f"and {lost} episodes begin anew" if lost else "and collects the same rollout",
        )  # fmt: skip
        self._make(i)


def _nones(length: int, lists: int) -> list[list[Any]]:
    return [[None] * length for _ in range(lists)]


class _Order(NamedTuple):
    """What an actor is given."""

    make: MakeSimulator
    first: int
    count: int
    num_envs: int
    seed: int
    actor: TensorDictModuleBase
    weights: Layout
    outputs: Entries
    keys: list[Any]
    layout: Layout
    compile: Mode
    matmul: dict[str, Any]


class RemoteShare:
    """A share of the environments in an actor; the first argument of each request is a step that must have worked."""

    def place(self, _: None = None) -> tuple[str, int]:
        """Where the actor has found a place: a machine's address, and the number of a process there."""
        return ray_module().util.get_node_ip_address(), os.getpid()

    def build(self, path: Sequence[str], order: bytes, past: Past) -> None:
        """Makes the environments and records the policy; brings them to where another share was."""
        sys.path.extend(folder for folder in path if folder not in sys.path)
        torch.set_num_threads(1)
        given: _Order = cloudpickle.loads(order)
        load_matmul_state(given.matmul)
        self._actor, self._weights = given.actor, given.weights
        self._block = torch.zeros(given.layout.size, dtype=torch.uint8)
        buffers = dict(zip(given.keys, given.layout.views(self._block), strict=True))
        self._share = Share(
            given.make(given.first, given.count, given.seed), given.first, given.num_envs, given.seed, self._actor,
            given.outputs, buffers, given.compile,
        )  # fmt: skip
        self._share.rebuild(past)

    def collect(
        self, _: None, weights: np.ndarray, step: int, random: bool, tells: bool
    ) -> tuple[np.ndarray, bytes | None]:
        """A rollout as one block, and the state after it if asked for."""
        with torch.no_grad():
            for mine, theirs in zip(self._actor.state_dict().values(), self._weights.unpack(weights), strict=True):
                mine.copy_(theirs)
        self._share.collect(step, random)
        return self._block.numpy(), self.state(None) if tells else None

    def state(self, _: None) -> bytes:
        """As :meth:`Share.state_dict`, pickled: of what Ray pickles, arrays are read-only."""
        return pickle.dumps(self._share.state_dict())

    def load(self, _: None, state: bytes) -> None:
        """As :meth:`Share.load_state_dict`."""
        self._share.load_state_dict(pickle.loads(state))
