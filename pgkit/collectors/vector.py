"""The fast collector: whole rollouts from a vector of environments, in one process or several."""

from __future__ import annotations

import time
from collections.abc import Iterator
from logging import getLogger
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from pgkit.collectors.actor import Beside, example
from pgkit.collectors.stepping import MASK, Share, allocate, as_rollout, lost, regroup
from pgkit.collectors.workers import MakePool, Pool, Workers, check_splits
from pgkit.compiled import Constants, choose
from pgkit.envs import VectorEnv, vector_of
from pgkit.errors import UserError, check_whole_number


class VectorCollector:
    """Iterates over rollouts: TensorDicts ``[num_envs, T]`` with TorchRL's keys, until ``total_frames``.

    Besides ``observation``, the actor's samples and log-probabilities and the ``next`` entries, a rollout has
    ``("next", "episode_reward")`` and ``("next", "step_count")``, return and length so far of the running episode.
    ``("next", "observation")`` is the true final observation where an episode ended.

    The numbers depend on the environment's seed and the weights only: not on ``env.workers``, not on the use made
    of torch's global random generator elsewhere.

    The policy acts in evaluation mode, whatever mode it is in: no dropout, and normalization by running statistics,
    which stay as they are. It is evaluated where the environments are; a rollout is brought to where the actor is, as a
    whole.

    Args:
        env: from :func:`pgkit.envs.make`; ``env.workers`` processes collect. Or any TorchRL environment with one batch
            dimension or none, transforms included.
        actor: TensorDict module from ``observation`` to ``action`` (and its log-probability). Its parameters are
            read before every rollout.
        frames_per_batch: frames of a rollout, a multiple of ``env.num_envs``.
        total_frames: frames after which iteration stops (with the rollout that reaches them); -1: never.
        init_random_frames: the rollouts that begin before so many frames draw actions uniformly from the action spec;
            their log-probability is NaN.
        compile: ``on``, ``off``, or ``auto``: where a C++ compiler is there and ``total_frames`` is large enough.
        pool: makes the processes that collect; None: :class:`~pgkit.collectors.workers.Workers`, for ``env.workers``
            above 1.

    Raises:
        UserError: sizes that do not fit, an actor that was built for another environment; while collecting,
            observations or rewards that are not finite.
    """

    def __init__(
        self,
        env: EnvBase,
        actor: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        init_random_frames: int = 0,
        compile: str = "auto",
        pool: MakePool | None = None,
    ) -> None:
        env = vector_of(env)
        self._pooled = env.workers > 1 or pool is not None
        if self._pooled:
            check_splits(env)
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
        self._outputs, self._beside = example(env, actor), Beside(actor, env)
        self._make_pool: MakePool = pool or Workers
        self._workers: Pool | None = None
        self._share: Share | None = None
        self._constants: Constants | None = None

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.total_frames < 0 or self.frames < self.total_frames:
            yield self.rollout()

    def rollout(self) -> TensorDictBase:
        """Collects one rollout with the actor's present weights."""
        step, random = self._rollouts * self._steps, self.frames < self.init_random_frames
        if self._pooled:
            self._pool().begin(self.actor.state_dict().values(), step, random)
            buffers = self._pool().finish()
        else:
            self._alone().collect(step, random)
            buffers = {key: x.clone() for key, x in self._buffers.items()}
        rollout = as_rollout(buffers, self.env)
        self.frames += count(rollout)
        self._rollouts += 1
        return self._beside.bring(rollout)

    def state_dict(self) -> dict[str, Any]:
        """Counters, and the state of every environment and of the policy's memory.

        After a rollout that failed, or :meth:`shutdown`, the environments have none: they begin new episodes.
        """
        closed = self._share is None and self._rollouts > 0 if self._workers is None else not self._workers.is_open
        if closed:
            shares = [lost(self._rollouts * self._steps)]
        else:
            shares = self._pool().state_dict() if self._pooled else [self._alone().state_dict()]
        return {"frames": self.frames, "rollouts": self._rollouts, "shares": shares}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`, also one taken with another number of workers."""
        self.frames, self._rollouts = state["frames"], state["rollouts"]
        say_resume(self.env, state["shares"][0])
        if self._pooled:
            self._pool().load_state_dict(state["shares"])
        else:
            self._alone().load_state_dict(regroup(state["shares"], [0, self.env.num_envs])[0])

    def shutdown(self) -> None:
        """Ends the worker processes and closes the environments."""
        if self._workers is not None:
            self._workers.close()
            self._workers = None
        self.env.close_simulator()
        self._share = None

    def _pool(self) -> Pool:
        """The workers; they get new weights only, and start again where something else in the actor was replaced."""
        state = None
        if self._workers is not None and not self._workers.is_open:  # one has failed
            state, self._workers = [lost(self._rollouts * self._steps)], None
        changed = self._constants.changed(memory=False) if self._workers and self._constants else None
        if self._workers is not None and changed:
            getLogger("pgkit").warning(
                "the workers start again: in the actor %s (a buffer changed in place, by fill_, needs no such thing)",
                changed,
            )
            state = self._workers.state_dict()
            self._workers.close()
            self._workers = None
        if self._workers is None:
            start = time.perf_counter()
            self._constants = Constants({"the actor": self.actor}, but={"training"})
            self._beside = Beside(self.actor, self.env)
            self._workers = self._make_pool(self.env, self._beside.actor, self._steps, self._outputs, self._compile)
            self.compile_seconds += time.perf_counter() - start
            if state is not None:
                self._workers.load_state_dict(state)
        return self._workers

    def _alone(self) -> Share:
        """All environments in this process; the policy is recorded again where something that it holds was replaced."""
        if self._share is None or self._constants is None or self._constants.changed():
            start = time.perf_counter()
            self._constants = Constants({"the actor": self.actor}, but={"training"})
            self._beside = Beside(self.actor, self.env)
            if self._share is None:
                self._buffers = allocate(self._steps, self.env, self._outputs)
                self._share = Share(
                    self.env.simulator, 0, self.env.num_envs, self.env.seed, self._beside.actor, self._outputs,
                    self._buffers, self._compile,
                )  # fmt: skip
            else:
                self._share.retrace(self._beside.actor, self._compile)
            self.compile_seconds += time.perf_counter() - start
        self._beside.refresh()
        return self._share


def count(rollout: TensorDictBase) -> int:
    """Frames of a rollout: all, or those whose action counted."""
    mask = rollout.get(MASK, None)
    return rollout.numel() if mask is None else int(mask.sum())


def say_resume(env: VectorEnv, share: dict[str, Any]) -> None:
    """The one line that says what a resume brings back."""
    is_lost = share["simulator"].keys() == {"steps"}
    exact = "every environment goes on where it was"
    if is_lost or env.resume != "exact":
        exact = "every environment begins anew"
    amid = ": the run before it ended in the middle of a rollout, or after the collector's shutdown()"
    why = amid if is_lost and env.resume == "exact" else ""
    getLogger("pgkit").info("the resumed run: %s%s (%s)", exact, why, env.env_id)
