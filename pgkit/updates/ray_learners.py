"""An update on several processes that Ray starts: the first learner is this one."""

from __future__ import annotations

import datetime
from typing import Any

import torch
import torch.distributed as dist
from tensordict import TensorDictBase

from pgkit.errors import UserError
from pgkit.messages import packed, unpacked
from pgkit.updates.data_parallel import data_parallel
from pgkit.updates.on_policy import OnPolicyUpdate

PATIENCE = datetime.timedelta(minutes=5)  # another learner may still be compiling


class RayLearners:
    """``update(rollout) -> dict[str, float]``: the update of :func:`data_parallel`, on actors of Ray and here.

    This process is the first learner. It cuts a rollout by environments, one share a learner, and brings back what the
    others write into theirs (``advantage``, ``value_target``). The others begin with a copy of the update; afterwards
    they follow the first one's weights, buffers and learning rates. Other attributes that change later do not reach
    them.

    Args:
        update: not called yet.
        learners: processes, this one included; they divide ``num_envs`` and ``minibatch_size``.
        timeout: seconds to wait for the cluster to start the others.

    Raises:
        UserError: the cluster has no room for the learners; while training, a learner is gone.
    """

    def __init__(self, update: OnPolicyUpdate, learners: int, *, timeout: float = 300.0) -> None:
        import ray
        from ray import cloudpickle

        if not ray.is_initialized():
            raise UserError("the learners are actors of Ray: call pgkit.collectors.connect(cpus=...) first")
        self.update, self.learners = update, learners
        gpus = 1 if next(update.loss.parameters()).is_cuda else 0
        start = ray.remote(_Learner).options(num_cpus=1, num_gpus=gpus)
        copy = ray.put(cloudpickle.dumps(update))
        self._others = [start.remote(copy, rank, learners) for rank in range(1, learners)]
        ready = ray.wait([o.__ray_ready__.remote() for o in self._others], num_returns=learners - 1, timeout=timeout)[0]
        if len(ready) < learners - 1:
            self._kill()
            raise UserError(
                f"{len(ready)} of {learners - 1} learners started within {timeout:g} s: each waits for a CPU"
                f"{' and a GPU' * gpus} of the cluster, which has {_amounts(ray.available_resources())} free; "
                "lower --learners or --collectors"
            )
        store = dist.TCPStore(ray.util.get_node_ip_address(), 0, learners, True, PATIENCE, wait_for_workers=False)
        joining = [other.join.remote(store.host, store.port, gpus) for other in self._others]
        dist.init_process_group(_backend(gpus), store=store, rank=0, world_size=learners, timeout=PATIENCE)
        data_parallel(update)
        ray.get(joining)

    def __call__(self, rollout: TensorDictBase) -> dict[str, float]:
        """Trains on a rollout ``[num_envs, T]``."""
        import ray

        if rollout.batch_size[0] % self.learners:
            raise UserError(
                f"{rollout.batch_size[0]} environments cannot be shared by {self.learners} learners in equal parts"
            )
        own, *shares = rollout.chunk(self.learners, 0)
        own = own.copy()
        seeds = [self.update.frames * self.learners + rank for rank in range(1, self.learners)]
        calls = zip(self._others, shares, seeds, strict=True)
        made = [other.train.remote(packed(share), seed) for other, share, seed in calls]
        before = set(rollout.keys(True, True))
        try:
            metrics = self.update(own)
            results = [own.select(*(key for key in own.keys(True, True) if key not in before)), *ray.get(made)]
        except Exception as error:
            self._explain(made)
            raise error
        first, *rest = results
        for key, mine in first.items(True, True):
            rollout.set(key, torch.cat([mine, *(torch.tensor(x[key], device=mine.device) for x in rest)]))
        return metrics

    def __str__(self) -> str:
        return f"{self.update}\non {self.learners} learners"

    @property
    def frames(self) -> int:
        """Frames trained on so far."""
        return self.update.frames

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far, here."""
        return self.update.compile_seconds

    def state_dict(self) -> dict[str, Any]:
        """That of the update."""
        return self.update.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict` in every learner."""
        import ray

        loading = [other.load.remote(state) for other in self._others]
        self.update.load_state_dict(state)
        ray.get(loading)

    def shutdown(self) -> None:
        """Ends the other learners."""
        self._kill()
        dist.destroy_process_group()

    def _kill(self) -> None:
        import ray

        for other in self._others:
            ray.kill(other)

    def _explain(self, made: list[Any]) -> None:
        """Raises what went wrong in another learner, if something did."""
        import ray

        for rank, result in enumerate(made, 1):
            try:
                ray.get(result, timeout=1.0)
            except ray.exceptions.RayActorError as error:
                raise UserError(
                    f"learner {rank} is gone ({str(error).splitlines()[0]}): go on from the last checkpoint with "
                    "--resume"
                ) from error
            except ray.exceptions.RayTaskError as error:
                if isinstance(error.cause, UserError):
                    raise error.cause from error
                if not isinstance(error.cause, RuntimeError):  # that is of who waited for the one that failed
                    raise error
            except ray.exceptions.GetTimeoutError:
                continue


class _Learner:
    """Another learner, in an actor of Ray."""

    def __init__(self, update: bytes, rank: int, size: int) -> None:
        from ray import cloudpickle

        torch.set_num_threads(1)
        self.update: OnPolicyUpdate = cloudpickle.loads(update)
        self.rank, self.size = rank, size

    def join(self, host: str, port: int, gpus: int) -> None:
        store = dist.TCPStore(host, port, self.size, False, PATIENCE)
        dist.init_process_group(_backend(gpus), store=store, rank=self.rank, world_size=self.size, timeout=PATIENCE)
        data_parallel(self.update)

    def train(self, share: dict[Any, Any], seed: int) -> dict[Any, Any]:
        torch.manual_seed(seed)
        device = next(self.update.loss.parameters()).device
        rollout = unpacked(share, device)
        try:
            self.update(rollout)
        except BaseException:
            dist.destroy_process_group()  # nobody waits for this one
            raise
        return packed(rollout.exclude(*share["entries"]))["entries"]

    def load(self, state: dict[str, Any]) -> None:
        self.update.load_state_dict(state)


def _backend(gpus: int) -> str:
    return "nccl" if gpus else "gloo"


def _amounts(resources: dict[str, float]) -> str:
    return f"{resources.get('CPU', 0):g} CPUs and {resources.get('GPU', 0):g} GPUs"
