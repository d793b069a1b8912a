"""Explorers in actors of Ray: each collects when it may, and sends what it saw to where frames are kept."""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Callable, Mapping
from logging import getLogger
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from pgkit.collectors.cluster import MOST_DEATHS, Waiting, failed, ray_module
from pgkit.collectors.workers import WorkerEnded
from pgkit.messages import packed, shipped

Weights = Mapping[str, Tensor]
Explore = Callable[[Weights], TensorDictBase]
_EPISODES = ("done", "episode_reward", "step_count")


class Store(Protocol):
    """Where rollouts go, e.g. :class:`pgkit.data.RayReplay`."""

    def emptiest(self, frames: int, /) -> tuple[int, Any]: ...

    def told(self, number: int, shard: Any, frames: int, stored: Any, /) -> None: ...


class RayExplorers:
    """Many actors that explore for one learner, as in Ape-X (Horgan et al., 2018, https://arxiv.org/abs/1803.00933).

    An explorer is a function ``explore(weights) -> rollout`` that remembers its environments. :meth:`collect` starts
    calls on the idle actors, as many as may run, and returns what the finished ones saw of episodes; the rollouts
    themselves go from actor to store. An actor that dies is replaced, and its episodes begin anew.

    Args:
        make: ``make(number, seed, frames) -> explore``, called in the actor after so many frames of all.
        explorers: how many.
        store: gets the rollouts.
        frames_per_call: frames of a rollout.
        total_frames: no call begins after so many.
        frames_per_update: frames that may be collected for each update of the learner, besides one call an explorer;
            None: the explorers run freely.
        seed: from which each explorer's is made; a resumed run's and a replaced actor's are others.
        niceness: of the actors, so that learner and replay go first where they share a processor.
        wait: seconds to wait for a place in the cluster.

    Raises:
        UserError: while collecting, the cluster has no place for an explorer.
        EnvironmentFailed: while collecting, an explorer died three times at one call.

    Attributes:
        frames: frames collected.
        restarts: actors that were replaced.
    """

    compile_seconds = 0.0  # it is the actors that compile

    def __init__(
        self,
        make: Callable[[int, int, int], Explore],
        explorers: int,
        store: Store,
        *,
        frames_per_call: int,
        total_frames: int,
        frames_per_update: float | None = None,
        seed: int = 0,
        niceness: int = 15,
        wait: float = 300.0,
    ) -> None:
        ray = ray_module()
        self._make = ray.put(shipped(make))
        self.explorers, self.store, self.frames_per_update = explorers, store, frames_per_update
        self.frames_per_call, self.total_frames = frames_per_call, total_frames
        self.frames = self.restarts = 0
        self._seed, self._niceness, self._wait, self._begun = seed, niceness, wait, 0
        self._since: tuple[int, int] | None = None  # frames begun and updates where the limit began to hold
        self._weights: Any = None
        self._idle, self._deaths = deque[int](), Counter[int]()  # deaths of an explorer since its last rollout
        self._actors, self._ready = dict[int, Any](), dict[int, Any]()
        self._running = dict[Any, tuple[int, int, Any]]()  # the call -> explorer, shard and its handle

    def publish(self, weights: Weights, updates: int) -> None:
        """The weights, after so many updates, of the calls that begin from now on."""
        arrays = {key: x.detach().cpu().numpy() for key, x in weights.items() if isinstance(x, Tensor)}
        self._weights = ray_module().put((arrays, updates))

    def collect(self, updates: int | None) -> TensorDictBase | None:
        """Starts calls and ends those that are done.

        Args:
            updates: of the learner so far; None: it waits for frames. Then there is no limit, and this waits for one.

        Returns:
            The ends of episodes in the rollouts that came in, ``[N, T]`` with ``next`` entries alone; None: none came.
        """
        ray = ray_module()
        self._begin(updates)
        calls = list(self._running)
        done = ray.wait(calls, num_returns=len(calls), timeout=0)[0] if calls else []
        waiting = Waiting("explorers", self._wait)
        while updates is None and calls and not done:
            waiting.go_on(list(self._ready.values()), 0.0)
            done = ray.wait(calls, num_returns=1, timeout=1.0)[0]
        reports = [report for call in done if (report := self._end(call)) is not None]
        self._begin(updates)
        if not reports:
            return None
        following = {key: torch.cat([torch.tensor(report[key]) for report in reports]) for key in reports[0]}
        size = following["done"].shape[:2]
        return TensorDict({"next": TensorDict(following, size)}, size)

    def state_dict(self) -> dict[str, Any]:
        """The frames collected; episodes under way are not kept."""
        return {"frames": self.frames}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`: every environment begins anew."""
        self.frames = self._begun = state["frames"]

    def shutdown(self) -> None:
        """Ends the actors."""
        for actor in self._actors.values():
            ray_module().kill(actor)
        for held in (self._running, self._actors, self._ready, self._idle):
            held.clear()

    def _most(self, updates: int | None) -> float:
        """Frames of which calls may have begun."""
        if updates is None or self.frames_per_update is None:
            self._since = None
            return self.total_frames
        begun, before = self._since = self._since or (self._begun, updates)
        due = (updates - before) * self.frames_per_update
        return min(begun + due + self.explorers * self.frames_per_call, self.total_frames)

    def _begin(self, updates: int | None) -> None:
        for number in range(len(self._actors), self.explorers):
            self._start(number)
        most = self._most(updates)
        while self._idle and self._begun < most:
            number = self._idle.popleft()
            shard, handle = self.store.emptiest(self.frames_per_call)
            call = self._actors[number].collect.remote(self._weights, handle)
            self._running[call] = number, shard, handle
            self._begun += self.frames_per_call

    def _end(self, call: Any) -> dict[str, np.ndarray] | None:
        ray = ray_module()
        number, shard, handle = self._running.pop(call)
        try:
            report, stored = ray.get(call)
        except ray.exceptions.RayTaskError as error:
            self.shutdown()
            failed(error, f"explorer {number}")
        except ray.exceptions.RayActorError as error:
            self._deaths[number] += 1
            if self._deaths[number] >= MOST_DEATHS:
                self.shutdown()
                raise WorkerEnded(f"explorer {number} ended {MOST_DEATHS} times at the same call: {error}") from None
            getLogger("pgkit").warning("explorer %d is gone: another takes its place", number)
            self.restarts += 1
            self._begun -= self.frames_per_call
            self._start(number)
            return None
        self.store.told(shard, handle, self.frames_per_call, stored)
        self._idle.append(number)
        self._deaths[number] = 0
        self.frames += self.frames_per_call
        return report

    def _start(self, number: int) -> None:
        words = np.random.SeedSequence((self._seed, number, self.frames, self.restarts)).generate_state(1)
        start = ray_module().remote(_Explorer).options(num_cpus=1)
        self._actors[number] = start.remote(self._make, number, int(words[0] >> 1), self.frames, self._niceness)
        self._ready[number] = self._actors[number].__ray_ready__.remote()
        self._idle.append(number)


class _Explorer:
    """An explorer in an actor of Ray."""

    def __init__(self, make: bytes, number: int, seed: int, frames: int, niceness: int) -> None:
        os.nice(niceness)
        torch.set_num_threads(1)
        self._order, self._explore = (make, number, seed, frames), None

    def collect(self, published: tuple[dict[str, np.ndarray], int], shard: Any) -> tuple[dict[Any, Any], Any]:
        """What the rollout has of episodes, and what the shard says; None if it is dead."""
        ray = ray_module()
        if self._explore is None:  # here: what fails in an actor's constructor looks like a death
            make, *given = self._order
            self._explore = ray.cloudpickle.loads(make)(*given)
        weights, updates = published
        rollout = self._explore({key: torch.tensor(x) for key, x in weights.items()})
        message = packed(rollout)
        try:
            stored = ray.get(shard.extend.remote(message, updates))
        except ray.exceptions.RayActorError:
            stored = None
        return {key: message["entries"]["next", key] for key in _EPISODES}, stored
