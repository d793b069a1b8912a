"""Where an off-policy update's batches come from: pgkit's replay, or any of TorchRL's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from pgkit.checks import LossView, device_of, replay
from pgkit.data import RayReplay, ReplayBuffer
from pgkit.errors import UserError

Draw = tuple[TensorDictBase, Tensor]


class OwnBatches:
    """From pgkit's replay: only row numbers are drawn, the rest is in the graph; a batch goes where the loss is.

    :meth:`extend` stores a rollout; :meth:`draw` gives a pair ``(data, index)`` a step, :meth:`gather` the batch of a
    pair and :meth:`write_back` takes its priorities, both in the graph; :meth:`written` is what that changes besides
    the data; :meth:`drawn` follows each step, outside the graph; :meth:`settings` has the owners of a ``gamma``.

    Attributes:
        capacity: frames that there can be to draw from.
    """

    def __init__(self, buffer: ReplayBuffer, loss: nn.Module, batch_size: int) -> None:
        self.buffer, self.view, self.batch_size = buffer, LossView(loss), batch_size
        self.priority = self.view.priority
        self.device = next((p.device for p in loss.parameters()), buffer.device)
        self.capacity = buffer.capacity - (buffer.n_steps - 1) * buffer.columns  # of the last the return is not known

    def extend(self, rollout: TensorDictBase) -> None:
        self.buffer.extend(rollout)

    def gather(self, data: TensorDictBase, index: Tensor) -> TensorDictBase:
        gamma = self.view.gamma if self.buffer.n_steps > 1 else 1.0
        batch = self.buffer.gather(gamma.to(self.buffer.device) if isinstance(gamma, Tensor) else gamma)(data, index)
        return batch if self.device.type == self.buffer.device.type else batch.to(self.device)

    def write_back(self, data: TensorDictBase, index: Tensor, batch: TensorDictBase) -> None:
        if self.buffer.sampler is None:
            return
        if self.priority not in batch.keys(True):
            raise UserError(
                f"the replay is prioritized, but {self.view.name} writes no '{self.priority}' into the "
                "batch: write the absolute error [*B] there, or draw uniformly"
            )
        errors = batch[self.priority].to(index.device).reshape(-1, len(index)).amax(0)  # of copies, the largest
        self.buffer.write_back(data, index, TensorDict({"td_error": errors}, errors.shape))

    def written(self) -> list[Tensor]:
        return [] if self.buffer.sampler is None else self.buffer.sampler.tensors

    def draw(self, batches: int) -> Iterator[Draw]:
        at_once = 1 if self.buffer.sampler is not None else max(batches, 1)  # priorities change with every step
        for first in range(0, batches, at_once):
            for index in self.buffer.sample_index(self.batch_size, min(at_once, batches - first)):
                yield self.buffer.data, index

    def drawn(self) -> None:
        pass

    def settings(self) -> dict[str, Any]:
        return {}


class TorchRLBatches:
    """From a TorchRL replay buffer: its ``sample()`` is called for every step, ``td_error`` is written back to it.

    The methods are those of :class:`OwnBatches`.
    """

    def __init__(self, buffer: Any, loss: nn.Module, batch_size: int) -> None:
        replay.check_replay(buffer)
        self.buffer, self.view, self.batch_size = buffer, LossView(loss), batch_size
        self.priority, self.prioritized = self.view.priority, replay.prioritized(buffer)
        self.capacity = buffer.storage.max_size

    def extend(self, rollout: TensorDictBase) -> None:
        replay.check_rollout(self.buffer, rollout)
        self.buffer.extend(rollout.reshape(-1))

    def draw(self, batches: int) -> Iterator[Draw]:
        for _ in range(batches):
            self._sample = self.buffer.sample(self.batch_size)
            data, device = self._sample.select(*self.view.readable(self._sample)), device_of(self._sample)
            self._batch = data.set(self.priority, torch.zeros(self.batch_size, device=device))
            yield self._batch, torch.arange(self.batch_size, device=device)

    def gather(self, data: TensorDictBase, index: Tensor) -> TensorDictBase:
        rows = data.exclude(self.priority)
        return rows if len(index) == self.batch_size else cast(TensorDictBase, rows[index])

    def write_back(self, data: TensorDictBase, index: Tensor, batch: TensorDictBase) -> None:
        if self.prioritized:
            data[self.priority].index_copy_(0, index, batch[self.priority].flatten().to(data[self.priority].dtype))

    def written(self) -> list[Tensor]:
        return []

    def drawn(self) -> None:
        if self.prioritized and self._batch[self.priority].isfinite().all():
            self.buffer.update_tensordict_priority(self._sample.set(self.priority, self._batch[self.priority]))

    def settings(self) -> dict[str, Any]:
        return replay.transforms(self.buffer)


class RemoteBatches:
    """From replay in other processes: the batches of a request lie in one block of rows, whose errors go back together.

    The methods are those of :class:`OwnBatches`.
    """

    def __init__(self, buffer: RayReplay, loss: nn.Module, batch_size: int) -> None:
        if batch_size != buffer.batch_size:
            raise UserError(f"batch_size={batch_size}, but the replay sends batches of {buffer.batch_size}: give both")
        self.buffer, self.batch_size, self.capacity = buffer, batch_size, buffer.capacity
        self.priority = LossView(loss).priority
        self._left = list[Tensor]()

    def extend(self, rollout: TensorDictBase) -> None:
        raise UserError("explorers fill this replay by themselves: call update.train(replay.batches)")

    def draw(self, batches: int) -> Iterator[Draw]:
        for _ in range(batches):
            if not self._left:
                self.buffer.fetch()
                rows = torch.arange(self.batch_size * self.buffer.batches, device=self.buffer.device)
                self._left = list(rows.split(self.batch_size))
            yield cast(TensorDictBase, self.buffer.data), self._left.pop(0)

    def gather(self, data: TensorDictBase, index: Tensor) -> TensorDictBase:
        return cast(TensorDictBase, data.exclude("td_error")[index])

    def write_back(self, data: TensorDictBase, index: Tensor, batch: TensorDictBase) -> None:
        data["td_error"].index_copy_(0, index, batch[self.priority].flatten().to(data["td_error"].dtype))

    def written(self) -> list[Tensor]:
        return []

    def drawn(self) -> None:
        self.buffer.updates += 1
        if not self._left:
            self.buffer.write_back()

    def settings(self) -> dict[str, Any]:
        return {}


Batches = OwnBatches | TorchRLBatches | RemoteBatches


def batches_of(buffer: Any, loss: nn.Module, batch_size: int) -> Batches:
    """The batches of this buffer, of so many rows."""
    kinds = {ReplayBuffer: OwnBatches, RayReplay: RemoteBatches}
    source = next((kinds[kind] for kind in kinds if isinstance(buffer, kind)), TorchRLBatches)
    return source(buffer, loss, batch_size)
