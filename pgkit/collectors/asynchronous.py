"""The collector that goes on while the learner updates: bounded, counted staleness."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from pgkit.collectors.actor import Beside, example
from pgkit.collectors.stepping import as_rollout, lost
from pgkit.collectors.vector import count, say_resume
from pgkit.collectors.workers import MakePool, Pool, Workers, check_splits, shares
from pgkit.compiled import choose
from pgkit.envs import vector_of
from pgkit.errors import UserError
from pgkit.seams import Entries


class AsyncCollector:
    r"""Iterates over rollouts that ``env.workers`` processes collect while the caller trains on the one before.

    A rollout is handed out, the next one is ordered with the weights of that moment, and the caller's update runs
    beside it. :attr:`lag` counts the updates between a rollout's weights and its hand-out (one update a rollout).

    Whole rollouts ``[num_envs, T]`` have a lag of exactly 1 and are the same numbers in every run. With ``per_worker``,
    each process delivers its own environments' ``[num_envs / workers, T]`` when it has them, in any order, and no
    rollout has a lag above ``max_lag`` (plus ``delay``): the actors of IMPALA (Espeholt et al., 2018,
    https://arxiv.org/abs/1802.01561).

    Args:
        env: from :func:`pgkit.envs.make`, of what can be made in another process.
        actor: as for :class:`~pgkit.collectors.VectorCollector`.
        frames_per_batch: frames of a rollout that is handed out.
        total_frames: frames after which iteration stops; -1: never.
        init_random_frames: frames at the start with actions drawn uniformly.
        per_worker: hand out each process's share by itself.
        max_lag: bound of the lag with ``per_worker``; by default twice the number of workers. At the number of
            workers, they take turns and runs repeat themselves.
        delay: order with the weights of so many updates ago: forced lag, to study it.
        compile: ``on``, ``off`` or ``auto``, for the policy.
        pool: makes the processes that collect.

    Raises:
        UserError: sizes that do not fit, environments that this process holds, or an actor that was built for another
            environment.
    """

    def __init__(
        self,
        env: EnvBase,
        actor: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        init_random_frames: int = 0,
        per_worker: bool = False,
        max_lag: int | None = None,
        delay: int = 0,
        compile: str = "auto",
        pool: MakePool = Workers,
    ) -> None:
        env = vector_of(env)
        check_splits(env)
        cuts = shares(env)
        self._bounds = [cuts[i : i + 2] for i in range(env.workers)] if per_worker else [cuts]
        columns = {bounds[-1] - bounds[0] for bounds in self._bounds}
        if len(columns) > 1 or frames_per_batch < 1 or frames_per_batch % min(columns):
            raise UserError(
                f"frames_per_batch={frames_per_batch} with {env.num_envs} environments over {env.workers} workers: "
                "each environment of a rollout takes the same number of steps, and each worker has as many environments"
            )
        self.max_lag = 2 * len(self._bounds) if max_lag is None else max_lag
        if self.max_lag < len(self._bounds):
            raise UserError(f"max_lag={max_lag} is less than the {len(self._bounds)} workers that take turns: raise it")
        self.env, self.actor, self.delay = env, actor, delay
        self.frames_per_batch, self.total_frames = frames_per_batch, total_frames
        self.init_random_frames = init_random_frames
        self.frames = self.lag = 0
        self.compile_seconds = 0.0  # starting the workers, which record and compile the policy
        self._steps = frames_per_batch // min(columns)
        calls = None if total_frames < 0 else total_frames / env.num_envs
        self._compile = choose(compile, calls, least_calls=50_000)
        self._outputs, self._beside = example(env, actor), Beside(actor, env)
        self._make_pool, self._groups = pool, list[Pool]()
        self._updates = 0  # rollouts handed out: the caller makes one update with each
        self._orders = [0] * len(self._bounds)  # rollouts ordered, by group
        self._versions = [0] * len(self._bounds)  # the update whose weights a group collects with
        self._done: list[Entries | None] = [None] * len(self._bounds)  # collected, not handed out (after a checkpoint)
        self._past: deque[tuple[int, list[Tensor]]] = deque(maxlen=delay + 1)  # weights, the oldest first

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.total_frames < 0 or self.frames < self.total_frames:
            yield self.rollout()

    def rollout(self) -> TensorDictBase:
        """The next rollout, and an order for the one after it."""
        if not all(workers.is_open for workers in self._groups):  # one has failed
            state = self.state_dict()
            self.shutdown()
            self.load_state_dict(state)
        if not self._groups:
            self._start()
            for group in range(len(self._groups)):
                self._order(group)
        group = self._next()
        buffers = self._done[group] or self._groups[group].finish()
        self._done[group] = None
        self.lag = self._updates - self._versions[group]
        self._order(group)
        rollout = as_rollout(buffers, self.env)
        self.frames += count(rollout)
        self._updates += 1
        return self._beside.bring(rollout)

    def state_dict(self) -> dict[str, Any]:
        """Counters, rollouts that are collected but not handed out yet, and every environment's state.

        After a rollout that failed, or :meth:`shutdown`, the environments have none: they begin new episodes.
        """
        if not all(workers.is_open for workers in self._groups) or (self._updates and not self._groups):
            gone = [[lost(count * self._steps)] for count in self._orders]
            return self._counters() | {"done": [None] * len(gone), "envs": gone}
        for group, workers in enumerate(self._groups):
            self._done[group] = self._done[group] or workers.finish()
        done = [arrays and dict(arrays) for arrays in self._done]
        return self._counters() | {"done": done, "envs": [workers.state_dict() for workers in self._groups]}

    def _counters(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "updates": self._updates,
            "orders": list(self._orders),
            "versions": list(self._versions),
            "past": [(version, [x.clone() for x in weights]) for version, weights in self._past],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`, taken with the same workers."""
        self.frames, self._updates = state["frames"], state["updates"]
        if not state["envs"]:
            return
        say_resume(self.env, state["envs"][0][0])
        if len(state["envs"]) != len(self._bounds):
            raise UserError(
                f"the checkpoint has rollouts of {len(state['envs'])} workers, there are {len(self._bounds)} now: "
                "resume with the same --workers"
            )
        self._orders, self._versions = list(state["orders"]), list(state["versions"])
        self._done, self._past = list(state["done"]), deque(state["past"], maxlen=self.delay + 1)
        if not self._groups:
            self._start()
        for group, (workers, saved) in enumerate(zip(self._groups, state["envs"], strict=True)):
            workers.load_state_dict(saved)
            if self._done[group] is None:  # its rollout failed
                self._order(group)

    def shutdown(self) -> None:
        """Ends the worker processes and closes the environments."""
        for workers in self._groups:
            workers.close()
        self._groups = []
        self.env.close_simulator()

    def _start(self) -> None:
        start = time.perf_counter()
        settings = self.env, self._beside.actor, self._steps, self._outputs, self._compile
        self._groups = [self._make_pool(*settings, bounds) for bounds in self._bounds]
        self.compile_seconds += time.perf_counter() - start

    def _order(self, group: int) -> None:
        """Starts a group's next rollout with the weights of now, or of ``delay`` updates ago."""
        version, weights = self._updates, list(self.actor.state_dict().values())
        if self.delay:
            if not self._past or self._past[-1][0] != version:
                self._past.append((version, [x.clone() for x in weights]))
            version, weights = self._past[0]
        self._versions[group] = version
        random = sum(self._orders) * self.frames_per_batch < self.init_random_frames
        step = self._orders[group] * self._steps
        self._orders[group] += 1
        self._groups[group].begin(weights, step, random)

    def _next(self) -> int:
        """The group to hand out: the oldest weights of those that are ready, or of all if one would get too old."""
        groups = range(len(self._groups))
        by_age = sorted(groups, key=lambda group: (self._versions[group], self._orders[group]))
        lags = [self._updates + turn - self._versions[group] for turn, group in enumerate(by_age)]
        if self.max_lag == len(groups) or max(lags) >= self.max_lag + self.delay:
            return by_age[0]
        while True:
            for group in by_age:
                if self._done[group] or self._groups[group].ready():
                    return group
            if not self._groups[0].wait_any(self._groups):
                return by_age[0]  # whose time is watched
