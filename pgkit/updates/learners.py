"""Learners that train one agent together, each on its own rows: what they average, and what they agree on."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import torch
import torch.distributed as dist
from tensordict import TensorDictBase
from torch import Tensor

from pgkit.checks import LossView
from pgkit.errors import UserError
from pgkit.updates.minibatches import frames_of

Batches = Sequence[tuple[Tensor, ...]]


class Alone:
    """One learner: there is nothing to average."""

    size = 1
    mean = None
    agree = bool

    def begin(self, rollout: TensorDictBase) -> int:
        return frames_of(rollout)

    def prepared(self, data: TensorDictBase, batches: Batches) -> TensorDictBase:
        return data


class Learners:
    """This process among the learners of a ``torch.distributed`` group.

    Args:
        state: tensors in which every learner begins an update as the first one has them: weights, buffers. Messages are
            made where the first of them is; a coefficient may lie elsewhere.
        optimizer: its learning rates are the first learner's as well.
        generator: of the minibatch order, likewise.
        view: the loss, which says where masks lie.
        standardized: entries of a minibatch that are standardized here, over the rows of all learners.
        group: the process group; None: the default one.

    Attributes:
        rank, size: this learner's number, and how many there are.
    """

    def __init__(
        self,
        state: Sequence[Tensor],
        optimizer: Any,
        generator: torch.Generator,
        view: LossView,
        standardized: Sequence[Any] = (),
        group: Any = None,
    ) -> None:
        self.rank, self.size, self.group = dist.get_rank(group), dist.get_world_size(group), group
        self.optimizer, self.generator, self.view, self.standardized = optimizer, generator, view, list(standardized)
        self.state = sorted(state, key=lambda x: -x.element_size())  # views of their bytes then begin at whole numbers
        self.device = state[0].device
        self._shares = deque[float]()

    def sum(self, x: Tensor) -> Tensor:
        """The sum over all learners, the same bits for each; written into ``x``."""
        dist.all_reduce(x, group=self.group)
        return x

    def gather(self, x: Tensor) -> Tensor:
        """The rows ``x [n, ...]`` of all learners in the order of their ranks, ``[size * n, ...]``."""
        parts = [torch.empty_like(x, memory_format=torch.contiguous_format) for _ in range(self.size)]
        dist.all_gather(parts, x.contiguous(), group=self.group)
        return torch.cat(parts)

    def agree(self, yes: bool) -> bool:
        """Whether all learners say yes."""
        vote = torch.tensor(int(yes), device=self.device)
        dist.all_reduce(vote, dist.ReduceOp.MIN, group=self.group)
        return bool(vote)

    @torch.no_grad()
    def begin(self, rollout: TensorDictBase) -> int:
        """Takes over the first learner's weights, buffers, learning rates and minibatch order; the frames of all.

        Raises:
            UserError: the learners have different numbers of rows.
        """
        sizes = torch.tensor([[rollout.numel(), frames_of(rollout)]], device=self.device)
        rows, frames = zip(*self.gather(sizes).tolist(), strict=True)
        if len(set(rows)) > 1:
            raise UserError(
                f"the learners have {[*rows]} rows of the rollout: give each the same number of environments"
            )
        self._shares.clear()
        groups, order = self.optimizer.param_groups, self.generator.get_state()
        rates = torch.tensor([float(group["lr"]) for group in groups], dtype=torch.float64, device=self.device)
        tensors = [rates, *self.state, order]
        message = torch.cat([x.detach().to(self.device).reshape(-1).view(torch.uint8) for x in tensors])
        dist.broadcast(message, dist.get_global_rank(self.group or dist.group.WORLD, 0), group=self.group)
        if self.rank == 0:
            return sum(frames)
        parts = message.split([x.numel() * x.element_size() for x in tensors])
        for x, part in zip(self.state, parts[1:-1], strict=True):
            x.copy_(part.view(x.dtype).view(x.shape))
        for group, rate in zip(groups, parts[0].view(torch.float64).tolist(), strict=True):
            group["lr"] = rate
        self.generator.set_state(parts[-1].cpu().clone())  # torch reads a view from its memory's beginning
        return sum(frames)

    @torch.no_grad()
    def prepared(self, data: TensorDictBase, batches: Batches) -> TensorDictBase:
        """The data of an epoch with these minibatches: what is standardized is, over the rows of all learners.

        Of rows with a mask, it notes how much each step's gradient here weighs among the others'.
        """
        parts = [index for batch in batches for index in batch]
        order = torch.cat(parts)
        sizes = torch.tensor([len(index) for index in parts], device=order.device)
        which = torch.arange(len(parts), device=order.device).repeat_interleave(sizes)
        for key in self.standardized:
            x, counts = data[key], self.view.counting(data, data[key], key)
            counts = torch.ones_like(x) if counts is None else counts.to(x.dtype)
            stats = _moments(*(y[order].reshape(len(order), -1) for y in (x, counts)), which, len(parts))
            _, mean, deviation = _combined(self.gather(stats[None]))
            shape = (-1, *[1] * (x.dim() - 1))
            standard = torch.empty_like(x)
            standard[order] = (x[order] - mean[which].view(shape)) / deviation[which].view(shape)
            data = data.copy().set(key, standard)
        if masks := [data[key] for key in self.view.masks if key in data.keys(True)]:
            own = torch.zeros(len(parts), dtype=torch.float64, device=order.device)
            own.index_add_(0, which, _together(masks)[order].reshape(len(order), -1).sum(1).double())
            ends = torch.tensor([len(batch) for batch in batches]).cumsum(0)[:-1].tolist()
            steps = torch.stack([counts.sum() for counts in own.tensor_split(ends)])
            self._shares.extend((steps / self.sum(steps.clone()).clamp_min(1)).tolist())
        return data

    def mean(self, results: Sequence[Tensor]) -> list[Tensor]:
        """The mean of each tensor over all learners, weighted by the rows that count: one all-reduce."""
        share = self._shares.popleft() if self._shares else 1 / self.size
        own = torch.cat([x.reshape(-1) for x in results])
        total = self.sum(own * share if share else torch.zeros_like(own))  # the mean of no rows is NaN
        parts = total.split([x.numel() for x in results])
        return [part.view(x.shape).to(x.dtype) for part, x in zip(parts, results, strict=True)]

    @torch.no_grad()
    def standardize(self, x: Tensor, mask: Tensor | None = None, dim: Sequence[int] | None = None) -> Tensor:
        """:func:`pgkit.functional.standardize` over the elements of all learners."""
        axes = list(range(x.dim()) if dim is None else dim)
        counts = (torch.ones_like(x, dtype=torch.bool) if mask is None else mask).to(x.dtype)
        kept = x.masked_fill(counts == 0, 0.0)  # a masked element may be NaN
        count = counts.sum(axes, keepdim=True)
        mean = kept.sum(axes, keepdim=True) / count.clamp_min(1)
        squares = ((kept - mean) * counts).square().sum(axes, keepdim=True)
        _, mean, deviation = _combined(self.gather(torch.stack([count, mean, squares])[None]))
        return (x - mean) / deviation


def _together(masks: Sequence[Tensor]) -> Tensor:
    """The product of masks ``[rows, ...]`` that may lack the last dimensions of one another."""
    dims = max(mask.dim() for mask in masks)
    spread = torch.broadcast_tensors(*(mask.reshape(*mask.shape, *[1] * (dims - mask.dim())) for mask in masks))
    return torch.stack([mask.to(masks[0].dtype) for mask in spread]).prod(0)


def _moments(x: Tensor, counts: Tensor, which: Tensor, parts: int) -> Tensor:
    """Count, mean and sum of squared deviations of the rows ``x [rows, n]`` of each part, ``[3, parts]``."""
    zeros, kept = x.new_zeros(parts), x.masked_fill(counts == 0, 0.0)
    count = zeros.index_add(0, which, counts.sum(1))
    mean = zeros.index_add(0, which, kept.sum(1)) / count.clamp_min(1)
    squares = ((kept - mean[which].unsqueeze(1)) * counts).square().sum(1)
    return torch.stack([count, mean, zeros.index_add(0, which, squares)])


def _combined(stats: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Count, mean and deviation of all samples, from each learner's ``[size, 3, ...]`` (Chan et al., 1979)."""
    count, mean, squares = stats.unbind(1)
    total = count.sum(0)
    whole = (count * mean).sum(0) / total.clamp_min(1)
    spread = (squares + count * (mean - whole).square()).sum(0)
    return total, whole, (spread / (total - 1).clamp_min(1)).sqrt().clamp_min(1e-6)
