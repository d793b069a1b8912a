"""Generalized advantage estimation over a rollout."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from pgkit.advantages.base import Advantage
from pgkit.errors import within
from pgkit.functional import generalized_advantage


class GAE(Advantage):
    """Writes ``advantage``, ``value_target`` and ``state_value`` (``[*B, T, 1]``) into a rollout ``[*B, T]``.

    Schulman et al., 2016 (https://arxiv.org/abs/1506.02438). This block owns gamma and lambda.

    Args:
        critic: value operator, reads the rollout's observation, writes ``state_value``.
        gamma: discount.
        lmbda: GAE's lambda.
        average_gae: standardize the advantage over the whole rollout (TorchRL's keyword), masked steps left out.
        per_agent: standardize each agent's advantage by itself, in place of all agents' together.
        return_scale: a :class:`~pgkit.modules.ReturnScale`; the critic then works in its unit and so does
            ``value_target``, while ``advantage`` stays in the rewards' unit.
    """

    lmbda: Tensor

    def __init__(
        self,
        critic: TensorDictModule,
        *,
        gamma: float = 0.99,
        lmbda: float = 0.95,
        average_gae: bool = False,
        per_agent: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__(critic, gamma=gamma, standardize=average_gae, per_agent=per_agent, return_scale=return_scale)
        within(0, 1, lmbda=lmbda)
        self.register_buffer("lmbda", torch.tensor(float(lmbda), dtype=torch.float64))

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        return generalized_advantage(value, next_value, *self.ends(value, rollout), self.gamma, self.lmbda)
