"""The settings of a recipe that collects on this machine or on a Ray cluster, and the collector that they choose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from pgkit.collectors import AsyncCollector, RayCollector, VectorCollector
from pgkit.errors import UserError
from pgkit.run.args import RunArgs, setting


@dataclass
class RayArgs(RunArgs):
    """Settings of a run that may be spread over a cluster."""

    ray: bool = setting(False, on_resume=True)
    """Collect in actors of Ray, on this machine or a cluster; the numbers stay the same."""
    collectors: int | None = setting(None, low=1, high=10_000, on_resume=True)
    """With --ray: the actors that collect; None: as many as --workers."""
    learners: int = setting(1, low=1, high=1024, on_resume=True)
    """With --ray: processes that share each update; they divide num_envs and minibatch_size."""
    ray_address: str | None = setting(None, on_resume=True)
    """With --ray: the cluster's address, auto or HOST:6379; None: RAY_ADDRESS, or Ray is started on this machine."""
    ray_wait: float = setting(300.0, above=0, on_resume=True)
    """With --ray: seconds to wait for a place in the cluster."""

    def processes(self) -> int:
        """Processes that collect.

        Raises:
            UserError: a setting that is for --ray alone.
        """
        if self.ray:
            return self.collectors or self.workers
        given = {"--collectors": self.collectors, "--learners": self.learners > 1, "--ray-address": self.ray_address}
        if named := [name for name, value in given.items() if value]:
            raise UserError(f"{named[0]} is for runs on Ray: add --ray (processes without Ray: --workers)")
        return self.workers


def collector(
    args: RayArgs,
    env: EnvBase,
    actor: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    overlap: bool = False,
    asynchronous: bool = False,
    **lag: Any,
) -> VectorCollector | AsyncCollector | RayCollector:
    """The collector of these settings, for ``env`` with ``args.processes()`` workers.

    Args:
        frames_per_batch: frames of a rollout that is handed out.
        overlap: the next rollout is collected beside the update.
        asynchronous: as ``overlap``, and each process delivers by itself.
        lag: with ``asynchronous``, ``max_lag`` and ``delay`` of :class:`~pgkit.collectors.AsyncCollector`.

    Raises:
        UserError: settings that exclude each other.
    """
    sizes: Any = {"frames_per_batch": frames_per_batch, "total_frames": args.total_frames, "compile": args.compile}
    if asynchronous and args.learners > 1:
        raise UserError(
            f"--learners {args.learners}: processes at their own pace feed one learner; leave it out (or ppo)"
        )
    if args.ray and overlap:
        raise UserError("--overlap: not with --ray, whose actors wait for the update; leave one of the two out")
    if args.ray:
        where = {"address": args.ray_address, "wait": args.ray_wait}
        return RayCollector(env, actor, **sizes, **where, asynchronous=asynchronous, **lag)
    if overlap or asynchronous:
        return AsyncCollector(env, actor, **sizes, per_worker=asynchronous, **lag)
    return VectorCollector(env, actor, **sizes)
