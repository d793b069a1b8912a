"""GRPO's advantage over a rollout: no critic, an attempt against the others of its group."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pgkit.advantages.base import Advantage, ends
from pgkit.functional import group_relative, lambda_return


class GroupRelative(Advantage):
    """The return of each row's first episode, standardized over a group of rows, for all of the episode's steps.

    Shao et al., 2024 (https://arxiv.org/abs/2402.03300). A rollout is ``[N, T]``; ``group_size`` neighbouring rows are
    attempts at one task, each from the rollout's start to its first ``done``. Later steps have advantage 0. The
    value target is the reward to go, for a loss that wants one.

    Args:
        group_size: attempts at one task; divides ``N``.
        gamma: discount.
        divide: by the group's standard deviation; False is Dr. GRPO's (https://arxiv.org/abs/2503.20783).
        standardize, return_scale: as in :class:`~pgkit.advantages.Advantage`.
    """

    def __init__(
        self,
        group_size: int,
        *,
        gamma: float = 1.0,
        divide: bool = True,
        standardize: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__(None, gamma=gamma, standardize=standardize, return_scale=return_scale)
        self.group_size, self.divide = group_size, divide

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        reward, done, terminated = ends(rollout)
        target = lambda_return(next_value, reward, done, terminated, self.gamma, 1.0)
        advantage = group_relative(target[:, 0, 0], self.group_size, self.divide)
        first = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1).cumsum(1) == 0
        return advantage.view(-1, 1, 1) * first, target
