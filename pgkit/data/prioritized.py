"""Prioritized draws (Schaul et al., 2016, https://arxiv.org/abs/1511.05952)."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from pgkit.data.sum_tree import SumTree
from pgkit.errors import within


class Prioritized:
    r"""Draws frame :math:`i` with probability :math:`p_i^\alpha / \sum_j p_j^\alpha`, :math:`p = |\delta| + \epsilon`.

    New frames get the largest priority so far, or that of the error they come with. The update writes the errors of its
    batches back. A batch has ``priority_weight``, the importance weights :math:`(N P(i))^{-\beta}` divided by the
    batch's largest.

    Args:
        alpha: how much the priorities count; 0 draws uniformly.
        beta: how far the weights correct for it, 1 is fully; change it at any time by :meth:`set_beta`.
        eps: added to every error.
    """

    def __init__(self, alpha: float = 0.6, beta: float = 0.4, eps: float = 1e-6) -> None:
        within(0, float("inf"), alpha=alpha, beta=beta, eps=eps)
        self.alpha, self.eps = alpha, eps
        self.beta = torch.tensor(float(beta))
        self.largest = torch.ones(1, dtype=torch.float64)  # [1]: a compiled graph loses writes to a float64 scalar

    @property
    def tensors(self) -> list[Tensor]:
        """What :meth:`write_back` changes."""
        return [self.tree.values, self.tree.sums, self.largest]

    def begin(self, rows: int, device: torch.device | str = "cpu") -> TensorDictBase:
        """Makes the tree; the result is what a batch's weights are made from."""
        self.tree = SumTree(rows, device)
        self.beta, self.largest = self.beta.to(device), self.largest.to(device)
        return TensorDict({"priority": self.tree.values, "beta": self.beta})

    def set_beta(self, beta: float) -> None:
        """Changes ``beta`` from the next batch on."""
        self.beta.fill_(beta)

    def extend(self, new: Tensor, gone: Tensor, td_error: Tensor | None = None) -> None:
        """Takes the rows ``gone`` out; the rows ``new`` get the priorities of their errors, or the largest one."""
        self.tree.set(gone, 0.0)
        self.tree.set(new, self.largest)
        if td_error is not None and len(new):
            self.write_back(new.to(td_error.device), td_error)

    def sample(self, batches: int, batch_size: int, generator: torch.Generator) -> Tensor:
        """Rows ``[batches, batch_size]``; drawn on the CPU, the generator's device."""
        share = torch.rand(batches * batch_size, generator=generator, dtype=torch.float64)
        return self.tree.find(share.to(self.tree.sums.device)).view(batches, batch_size)

    def write_back(self, index: Tensor, td_error: Tensor) -> None:
        """Makes the errors ``[B]`` the priorities of the rows ``index [B]``; compiles into the update.

        A row whose error is not finite keeps its priority.
        """
        priority = (td_error.abs().double() + self.eps) ** self.alpha
        priority = torch.where(priority.isfinite(), priority, self.tree.values[index])
        self.largest.copy_(torch.maximum(self.largest, priority.max()))
        self.tree.set(index, priority)

    def state_dict(self) -> dict[str, Any]:
        """Priorities, the largest so far and ``beta``."""
        return {
            "priority": self.tree.values.clone(),
            "largest": self.largest.clone(),
            "beta": self.beta.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self.largest.copy_(state["largest"])
        self.beta.copy_(state["beta"])
        self.tree.set(torch.arange(len(self.tree.values)), state["priority"].to(self.tree.values.device))
