"""Deterministic actors: observation in, one action out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.modules.mlp import orthogonal
from pgkit.modules.sizes import action_size, box_action
from pgkit.modules.trunk import headed, trunk


def deterministic_actor(
    env: EnvBase,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    *,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
) -> TensorDictModule:
    """One action a state, squashed by tanh into the action's bounds: ``observation [*B, obs] -> action [*B, actions]``.

    It explores nothing by itself: collect with :class:`~pgkit.modules.GaussianExploration` or
    :class:`~pgkit.modules.OrnsteinUhlenbeck` around it.

    Args:
        env: any TorchRL environment with a bounded continuous action.
        hidden, activation, normalizer, encoder: as in :func:`~pgkit.modules.gaussian_actor`.
    """
    space: Any = box_action(env, needs_bounds=True).space
    layers, features = trunk(env, hidden, activation, normalizer, encoder)
    head = orthogonal(nn.Linear(features, action_size(env)), 0.01)
    return headed(layers, nn.Sequential(head, Squash(space.low, space.high)), ["action"])


class Squash(nn.Module):
    r"""Any number into its bounds: :math:`\frac{high + low}{2} + \frac{high - low}{2} \tanh x`, ``[*B, actions]``."""

    middle: Tensor
    half_range: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("middle", (high + low) / 2)
        self.register_buffer("half_range", (high - low) / 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.middle + self.half_range * torch.tanh(x)
