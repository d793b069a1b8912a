"""The collector whose processes may be on any machine of a Ray cluster."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from pgkit.collectors.asynchronous import AsyncCollector
from pgkit.collectors.cluster import connect
from pgkit.collectors.ray_workers import RayWorkers
from pgkit.collectors.vector import VectorCollector
from pgkit.envs import vector_of


class RayCollector:
    """Iterates over rollouts that ``env.workers`` Ray actors collect, on this machine or others.

    Each actor holds its share of the environments and the policy, evaluates its own rows only, and sends its share of a
    rollout as one block. It is otherwise a :class:`~pgkit.collectors.VectorCollector`: the numbers are the same bit for
    bit, for any number of actors, and checkpoints of one are checkpoints of the other. With ``asynchronous`` it is an
    :class:`~pgkit.collectors.AsyncCollector` with ``per_worker``: each actor's share is handed out by itself, when it
    comes, with a :attr:`lag` that is bounded.

    An actor that dies is made again and collects the same rollout; see ``docs/pages/howto/scale-out.md``.

    Args:
        env: from :func:`pgkit.envs.make`, with ``workers``: the number of actors.
        actor: as for ``VectorCollector``.
        frames_per_batch: frames of a rollout that is handed out.
        total_frames: frames after which iteration stops; -1: never.
        init_random_frames: frames at the start with actions drawn uniformly.
        asynchronous: collect beside the update, each actor at its own pace.
        max_lag, delay: with ``asynchronous``, as of ``AsyncCollector``.
        compile: ``on``, ``off`` or ``auto``, for the policy.
        address: of the cluster (``auto``, ``HOST:6379``, ``ray://HOST:10001``); None: ``RAY_ADDRESS``, or else Ray is
            started on this machine, with a place for every actor.
        wait: seconds to wait for a place in the cluster.

    Raises:
        UserError: as of ``VectorCollector``; Ray is not installed, no cluster answers at the address, or it has no
            place for an actor within ``wait`` seconds.
    """

    def __init__(
        self,
        env: EnvBase,
        actor: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        init_random_frames: int = 0,
        asynchronous: bool = False,
        max_lag: int | None = None,
        delay: int = 0,
        compile: str = "auto",
        address: str | None = None,
        wait: float = 300.0,
    ) -> None:
        env = vector_of(env)
        sizes = {"frames_per_batch": frames_per_batch, "total_frames": total_frames}
        settings: Any = {**sizes, "init_random_frames": init_random_frames, "compile": compile, "pool": self._pool}
        self._wait, self.pools = wait, list[RayWorkers]()
        if asynchronous:
            self._inner = AsyncCollector(env, actor, **settings, per_worker=True, max_lag=max_lag, delay=delay)
        else:
            self._inner = VectorCollector(env, actor, **settings)
        connect(address, env.workers)

    def __iter__(self) -> Iterator[TensorDictBase]:
        return iter(self._inner)

    def rollout(self) -> TensorDictBase:
        """The next rollout."""
        return self._inner.rollout()

    @property
    def frames(self) -> int:
        """Frames handed out so far."""
        return self._inner.frames

    @property
    def lag(self) -> int:
        """Updates between the weights of the last rollout and its hand-out."""
        return self._inner.lag if isinstance(self._inner, AsyncCollector) else 0

    @property
    def compile_seconds(self) -> float:
        """Seconds of starting the actors, which record and compile the policy."""
        return self._inner.compile_seconds

    @property
    def deaths(self) -> int:
        """Actors that died and were made again."""
        return sum(pool.deaths for pool in self.pools)

    @property
    def lost(self) -> int:
        """Episodes that those deaths cut short: none where the environments can be brought to where they were."""
        return sum(pool.lost for pool in self.pools)

    def state_dict(self) -> dict[str, Any]:
        """As of the collector that it is like; a number of actors is as good as another."""
        return self._inner.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self._inner.load_state_dict(state)

    def shutdown(self) -> None:
        """Ends the actors. Ray itself ends with this process."""
        self._inner.shutdown()

    def _pool(self, *settings: Any) -> RayWorkers:
        self.pools.append(RayWorkers(*settings, wait=self._wait))
        return self.pools[-1]
