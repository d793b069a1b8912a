"""The fast collector: whole rollouts from a vector of environments, in one process or several."""

from __future__ import annotations

import time
from collections.abc import Iterator
from logging import getLogger
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from pgkit.collectors.policy import Act, check_env, example, output_keys, random_actions, trace
from pgkit.collectors.stepping import allocate, as_rollout, fill
from pgkit.collectors.workers import Workers
from pgkit.compiled import Constants, choose
from pgkit.envs import VectorEnv
from pgkit.envs.arrays import episode_seed
from pgkit.errors import UserError, check_whole_number


class VectorCollector:
    """Iterates over rollouts: TensorDicts ``[num_envs, T]`` with TorchRL's keys, until ``total_frames``.

    Besides ``observation``, the actor's samples and log-probabilities and the ``next`` entries, a rollout has
    ``("next", "episode_reward")`` and ``("next", "step_count")``, return and length so far of the running episode.
    ``("next", "observation")`` is the true final observation where an episode ended.

    The numbers depend on the environment's seed and the weights only: not on ``env.workers``, not on the use made
    of torch's global random generator elsewhere.

    Args:
        env: from :func:`pgkit.envs.make`; ``env.workers`` processes collect.
        actor: TensorDict module from ``observation`` to ``action`` (and its log-probability). Its parameters are
            read before every rollout.
        frames_per_batch: frames of a rollout, a multiple of ``env.num_envs``.
        total_frames: frames after which iteration stops (with the rollout that reaches them); -1: never.
        init_random_frames: the rollouts that begin before so many frames draw actions uniformly from the action spec;
            their log-probability is NaN.
        compile: ``on``, ``off``, or ``auto``: where a C++ compiler is there and ``total_frames`` is large enough.

    Raises:
        UserError: sizes that do not fit, an environment of TorchRL's own (transforms included), or an actor that was
            built for another environment.
    """

    def __init__(
        self,
        env: VectorEnv,
        actor: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        init_random_frames: int = 0,
        compile: str = "auto",
    ) -> None:
        check_env(env, self)
        check_whole_number(1, frames_per_batch=frames_per_batch)
        if frames_per_batch % env.num_envs:
            raise UserError(
                f"frames_per_batch={frames_per_batch} is not a multiple of the {env.num_envs} environments: each takes "
                "the same number of steps"
            )
        if 0 <= total_frames < frames_per_batch:
            raise UserError(
                f"total_frames={total_frames} is less than one rollout (frames_per_batch={frames_per_batch}): raise "
                "the first or lower the second"
            )
        self.env, self.actor = env, actor
        self.frames_per_batch, self.total_frames = frames_per_batch, total_frames
        self.init_random_frames = init_random_frames
        self.frames = self._rollouts = 0
        self.compile_seconds = 0.0  # recording and compiling the policy, starting the workers
        self._steps = frames_per_batch // env.num_envs
        steps = None if total_frames < 0 else total_frames / env.num_envs
        self._compile = choose(compile, steps, least_calls=50_000)
        self._keys = output_keys(actor)
        self._outputs = dict(zip(self._keys, example(env, actor), strict=True))
        self._workers: Workers | None = None
        self._act: Act | None = None
        self._constants: Constants | None = None

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.total_frames < 0 or self.frames < self.total_frames:
            yield self.rollout()

    def rollout(self) -> TensorDictBase:
        """Collects one rollout with the actor's present weights."""
        seed = episode_seed(self.env.seed, -1 % 2**32, self._rollouts)
        random = self.frames < self.init_random_frames
        if self.env.workers > 1:
            self._pool().begin(self.actor.state_dict().values(), seed, random)
            arrays = self._pool().finish()
        else:
            obs = self.env.arrays.obs
            arrays = allocate(self._steps, obs, self._outputs)
            act = random_actions(self.env.action_spec, self._outputs, self.env.split) if random else self._policy()
            with torch.random.fork_rng(devices=[]):
                fill(arrays, self.env.arrays, act, self._keys, self.env.num_envs, seed)
        self.frames += self.frames_per_batch
        self._rollouts += 1
        return as_rollout(arrays, self.env)

    def state_dict(self) -> dict[str, Any]:
        """Counters, and every environment's state (see :class:`~pgkit.envs.ArrayEnv`)."""
        envs = self._pool() if self.env.workers > 1 else self.env.arrays
        return {"frames": self.frames, "rollouts": self._rollouts, "envs": envs.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`, also one taken with another number of workers."""
        self.frames, self._rollouts = state["frames"], state["rollouts"]
        envs = self._pool() if self.env.workers > 1 else self.env.arrays
        envs.load_state_dict(state["envs"])

    def shutdown(self) -> None:
        """Ends the worker processes and closes the environments."""
        if self._workers is not None:
            self._workers.close()
            self._workers = None
        self.env.close_arrays()

    def _pool(self) -> Workers:
        """The workers; they get new weights only, and start again where something else in the actor was replaced."""
        changed = self._constants.changed(memory=False) if self._workers and self._constants else None
        state = None
        if self._workers is not None and changed:
            getLogger("pgkit").warning(
                "the workers start again: %s (a buffer changed in place, by fill_, needs no such thing)",
                changed,
            )
            state = self._workers.state_dict()
            self._workers.close()
            self._workers = None
        if self._workers is None:
            start = time.perf_counter()
            self._constants = Constants({"the actor": self.actor})
            self._workers = Workers(self.env, self.actor, self._steps, self._outputs, self._compile)
            self.compile_seconds += time.perf_counter() - start
            if state is not None:
                self._workers.load_state_dict(state)
        return self._workers

    def _policy(self) -> Act:
        """The traced actor, traced again where something that it holds was replaced."""
        if self._act is None or self._constants is None or self._constants.changed():
            start = time.perf_counter()
            obs = torch.from_numpy(self.env.arrays.obs)
            self._constants = Constants({"the actor": self.actor})
            self._act = trace(self.actor, obs, self._compile, self.env.split)
            self.compile_seconds += time.perf_counter() - start
        return self._act
