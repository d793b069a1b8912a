"""Where an off-policy update's batches come from: pgkit's replay, or any of TorchRL's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from pgkit.data import ReplayBuffer
from pgkit.errors import UserError
from pgkit.updates import wiring

Draw = tuple[TensorDictBase, Tensor]


class OwnBatches:
    """From pgkit's replay: only row numbers are drawn, the rest is in the graph.

    :meth:`extend` stores a rollout; :meth:`draw` gives a pair ``(data, index)`` a step, :meth:`gather` the batch of a
    pair and :meth:`write_back` takes its priorities, both in the graph; :meth:`written` is what that changes besides
    the data; :meth:`drawn` follows each step, outside the graph; :meth:`settings` has the owners of a ``gamma``.
    """

    def __init__(self, buffer: ReplayBuffer, loss: nn.Module, batch_size: int) -> None:
        self.buffer, self.loss, self.batch_size = buffer, loss, batch_size
        self.priority = priority_key(loss)

    def extend(self, rollout: TensorDictBase) -> None:
        self.buffer.extend(rollout)

    def gather(self, data: TensorDictBase, index: Tensor) -> TensorDictBase:
        return self.buffer.gather(discount(self.loss) if self.buffer.n_steps > 1 else 1.0)(data, index)

    def write_back(self, data: TensorDictBase, index: Tensor, batch: TensorDictBase) -> None:
        if self.buffer.sampler is None:
            return
        if self.priority not in batch.keys(True):
            raise UserError(
                f"the replay is prioritized, but {type(self.loss).__name__} writes no '{self.priority}' into the "
                "batch: write the absolute error [*B] there, or draw uniformly"
            )
        self.buffer.write_back(data, index, batch.select().set("td_error", batch[self.priority]))

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
        self.buffer, self.loss, self.batch_size = buffer, loss, batch_size
        self.priority = priority_key(loss)
        self.prioritized = (
            hasattr(getattr(buffer, "sampler", None), "update_priority")
            and "Prioritized" in type(buffer.sampler).__name__
        )

    def extend(self, rollout: TensorDictBase) -> None:
        if rollout.batch_dims > 1 and rollout.batch_size[0] > 1 and "MultiStepTransform" in str(self.settings()):
            raise UserError(
                f"TorchRL's MultiStepTransform would add up rewards of {rollout.batch_size[0]} environments: collect "
                "with one, or use pgkit.data.ReplayBuffer(env, n_steps=...)"
            )
        self.buffer.extend(rollout.reshape(-1))

    def draw(self, batches: int) -> Iterator[Draw]:
        for _ in range(batches):
            self._sample = self.buffer.sample(self.batch_size)
            data = self._sample.select(*wiring.read_keys(self.loss, self._sample))
            self._batch = data.set(self.priority, torch.zeros(self.batch_size, device=data.device))
            yield self._batch, torch.arange(self.batch_size, device=data.device)

    def gather(self, data: TensorDictBase, index: Tensor) -> TensorDictBase:
        rows = data.exclude(self.priority)
        return rows if len(index) == self.batch_size else cast(TensorDictBase, rows[index])

    def write_back(self, data: TensorDictBase, index: Tensor, batch: TensorDictBase) -> None:
        if self.prioritized:
            data[self.priority].index_copy_(0, index, batch[self.priority].flatten().to(data[self.priority].dtype))

    def written(self) -> list[Tensor]:
        return []

    def drawn(self) -> None:
        if self.prioritized:
            self.buffer.update_tensordict_priority(self._sample.set(self.priority, self._batch[self.priority]))

    def settings(self) -> dict[str, Any]:
        transforms = getattr(self.buffer, "_transform", None)
        return {f"{type(t).__name__} of {type(self.buffer).__name__}": t for t in transforms or ()}


Batches = OwnBatches | TorchRLBatches


def priority_key(loss: nn.Module) -> Any:
    """Where a loss writes the priorities of a batch."""
    return getattr(getattr(loss, "tensor_keys", None), "priority", "td_error")


def discount(loss: nn.Module) -> Any:
    """The discount of a loss: its own ``gamma``, or its value estimator's."""
    owner = loss if getattr(loss, "gamma", None) is not None else getattr(loss, "value_estimator", None)
    if owner is None:
        raise UserError(f"n-step returns are discounted by the loss's gamma: give {type(loss).__name__} one")
    return owner.gamma
