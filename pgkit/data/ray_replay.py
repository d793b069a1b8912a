"""Prioritized replay in shards, each in an actor of Ray: Ape-X's (Horgan et al., 2018)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from logging import getLogger
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from pgkit.data.prioritized import Prioritized
from pgkit.data.replay import ReplayBuffer
from pgkit.errors import UserError, check_whole_number
from pgkit.messages import shipped, unpacked


class Request(NamedTuple):
    """Batches that a shard was asked for."""

    number: int
    shard: Any
    reply: Any


class RayReplay:
    r"""What explorers write to and one learner reads from: several batches a request, fetched ahead.

    Each shard is a prioritized :class:`~pgkit.data.ReplayBuffer` in an actor of its own. A request draws ``batches``
    batches from one shard, chosen in proportion to its sum of priorities; ``ahead`` requests are under way while the
    learner trains. The errors of a request's batches go back together, after the last of them; a frame that was
    overwritten meanwhile keeps the priority of its successor. Horgan et al., 2018 (https://arxiv.org/abs/1803.00933).

    A shard that dies begins anew, empty. Explorers send their rollouts to the shard that has least (:meth:`emptiest`),
    so it fills again before the others go on; until it has ``least`` frames nothing is drawn from it.

    Give it to :class:`pgkit.updates.OffPolicyUpdate` as its buffer and call ``update.train(replay.batches)``
    whenever :meth:`ready`.

    Args:
        make: ``make(number) -> ReplayBuffer`` with :class:`~pgkit.data.Prioritized` draws, called in shard ``number``.
        shards: number of actors.
        batch_size: rows of a batch.
        batches: batches of a request.
        ahead: requests under way besides the one in use.
        gamma: discount of n-step returns.
        least: frames in a shard before anything is drawn from it, at least ``batch_size``.
        device: where :attr:`data` is.
        timeout: seconds to wait for the cluster to start the shards.

    Attributes:
        data: the batches of the request in use, ``[batches * batch_size]``; the next one overwrites them.
        age: updates since the priorities of these rows were made, on average.
        updates: steps that the learner has taken; it counts them here.

    Raises:
        UserError: the cluster has no room for the shards.
    """

    def __init__(
        self,
        make: Callable[[int], ReplayBuffer],
        *,
        shards: int = 2,
        batch_size: int = 256,
        batches: int = 8,
        ahead: int = 2,
        gamma: float = 1.0,
        least: int = 1,
        device: torch.device | str = "cpu",
        timeout: float = 300.0,
    ) -> None:
        import ray

        check_whole_number(1, shards=shards, batch_size=batch_size, batches=batches, ahead=ahead)
        self.batch_size, self.batches, self.ahead, self.gamma = batch_size, batches, ahead, gamma
        self.least, self.device = max(least, batch_size), torch.device(device)
        self._make = ray.put(shipped(make))
        self._shards = [self._start(number) for number in range(shards)]
        told = [shard.capacity.remote() for shard in self._shards]
        if waiting := ray.wait(told, num_returns=shards, timeout=timeout)[1]:
            raise UserError(
                f"{len(waiting)} of {shards} shards of the replay have no place within {timeout:g} s: each needs 1 "
                f"CPU, the cluster has {ray.available_resources().get('CPU', 0):g} free"
            )
        self.capacity = sum(ray.get(told))
        self._stored, self._mass = [0] * shards, [0.0] * shards
        self._sent = [0] * shards  # frames on their way to a shard
        self._requests = deque[Request]()
        self._next: tuple[Request, dict[str, Any]] | None = None
        self._rng = np.random.default_rng(0)
        self.data: TensorDictBase | None = None
        self.age, self.updates = 0.0, 0

    def __len__(self) -> int:
        """Frames stored, as far as the shards have told."""
        return sum(self._stored)

    def emptiest(self, frames: int) -> tuple[int, Any]:
        """Number and handle of the shard that the next rollout, of so many frames, should go to."""
        number = min(range(len(self._shards)), key=lambda i: self._stored[i] + self._sent[i])
        self._sent[number] += frames
        return number, self._shards[number]

    def told(self, number: int, shard: Any, frames: int, stored: tuple[int, float] | None) -> None:
        """What came of a rollout of so many frames: the shard's frames and its priorities' sum, or None: it is dead."""
        if self._shards[number] is not shard:  # another took its place
            return
        self._sent[number] = max(self._sent[number] - frames, 0)
        if stored is not None:
            self._stored[number], self._mass[number] = stored
            return
        getLogger("pgkit").warning("shard %d of the replay is gone: it begins anew, empty", number)
        self._shards[number] = self._start(number)
        self._stored[number], self._mass[number], self._sent[number] = 0, 0.0, 0
        self._requests = deque(request for request in self._requests if request.number != number)

    def ready(self) -> bool:
        """Whether the next batches are here: waits for a request under way; False where no shard has frames enough."""
        import ray

        while self._next is None:
            masses = np.array(self._mass) * (np.array(self._stored) >= self.least)
            if masses.sum() == 0:
                return False
            while len(self._requests) <= self.ahead:
                number = int(self._rng.choice(len(masses), p=masses / masses.sum()))
                reply = self._shards[number].sample.remote(self.batch_size, self.batches)
                self._requests.append(Request(number, self._shards[number], reply))
            request = self._requests.popleft()
            try:
                self._next = request, ray.get(request.reply)
            except ray.exceptions.RayActorError:
                self.told(request.number, request.shard, 0, None)
        return True

    def fetch(self) -> None:
        """Puts the next request's batches into :attr:`data`.

        Raises:
            UserError: no shard has frames enough.
        """
        if not self.ready() or self._next is None:
            raise UserError("no shard of the replay has frames enough to draw from: train where replay.ready()")
        (self._current, reply), self._next = self._next, None
        self._frames, self.age = reply["frames"], self.updates - reply["updates"]
        self.told(self._current.number, self._current.shard, 0, reply["stored"])
        if self.data is None:
            self._here = {key: torch.tensor(x) for key, x in reply["entries"].items()}
            self.data = data = TensorDict({"td_error": torch.zeros(len(self._frames), device=self.device)})
            for key, x in self._here.items():
                data.set(key, x.to(self.device))
            data.batch_size = [len(self._frames)]
            self._place = {key: data[key] for key in self._here}
        for key, x in reply["entries"].items():
            np.copyto(self._here[key].numpy(), x)
            if self.device.type != "cpu":
                self._place[key].copy_(self._here[key])

    def write_back(self) -> None:
        """Sends the ``td_error`` of the request in use to its shard."""
        assert self.data is not None
        errors = self.data["td_error"].cpu().numpy().copy()
        self._current.shard.write_back.remote(self._frames, errors, self.updates)

    def shutdown(self) -> None:
        """Ends the shards."""
        import ray

        for shard in self._shards:
            ray.kill(shard)

    def _start(self, number: int) -> Any:
        import ray

        return ray.remote(_Shard).options(num_cpus=1).remote(self._make, number, self.gamma)


class _Shard:
    """A replay buffer in an actor of Ray, and after how many updates each priority was made."""

    def __init__(self, make: bytes, number: int, gamma: float) -> None:
        from ray import cloudpickle

        torch.set_num_threads(1)
        self.buffer: ReplayBuffer = cloudpickle.loads(make)(number)
        self.sampler: Prioritized = cast(Prioritized, self.buffer.sampler)
        self.made_at = torch.zeros(self.buffer.rows, dtype=torch.float64)
        self.gather = self.buffer.gather(gamma)

    def capacity(self) -> int:
        return self.buffer.capacity

    def extend(self, rollout: Mapping[str, Any], updates: int) -> tuple[int, float]:
        data = unpacked(rollout)
        self.buffer.extend(data)
        written = torch.arange(max(self.buffer.written - data.numel(), 0), self.buffer.written)
        self.made_at[written % self.buffer.rows] = updates
        return self.stored()

    def stored(self) -> tuple[int, float]:
        """Frames that can be drawn, and the sum of their priorities."""
        return len(self.buffer), float(self.sampler.tree.sums.sum())

    def sample(self, batch_size: int, batches: int) -> dict[str, Any]:
        index = self.buffer.sample_index(batch_size, batches)
        drawn = torch.stack([self.gather(self.buffer.data, rows) for rows in index]).reshape(-1)
        rows, start = index.flatten(), self.buffer.start
        return {
            "entries": {key: x.numpy() for key, x in drawn.items(True, True)},
            "frames": (start + (rows - start) % self.buffer.rows).numpy(),  # rows are used again, frames are not
            "updates": float(self.made_at[rows].mean()),
            "stored": self.stored(),
        }

    def write_back(self, frames: np.ndarray, errors: np.ndarray, updates: int) -> None:
        number, error = torch.tensor(frames), torch.tensor(errors)
        kept = number >= self.buffer.start
        rows = number[kept] % self.buffer.rows
        self.sampler.write_back(rows, error[kept])
        self.made_at[rows] = updates

    def priorities(self, frames: Sequence[int]) -> list[float]:
        """Those of frames that are kept."""
        return self.sampler.tree.values[torch.tensor(frames) % self.buffer.rows].tolist()
