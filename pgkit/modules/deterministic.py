"""Deterministic actors: observation in, one action out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.modules.groups import Share, agents
from pgkit.modules.sizes import box_action
from pgkit.modules.trunk import headed, trunk


def deterministic_actor(
    env: EnvBase,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    *,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    device: torch.device | str | None = None,
) -> TensorDictModule:
    """One action a state, squashed by tanh into the action's bounds: ``observation [*B, obs] -> action [*B, actions]``.

    It explores nothing by itself: collect with :class:`~pgkit.modules.GaussianExploration` or
    :class:`~pgkit.modules.OrnsteinUhlenbeck` around it.

    Args:
        env: any TorchRL environment with a bounded continuous action.
        hidden, activation, normalizer, encoder, group, share_parameters, agent_ids, device: as in
            :func:`~pgkit.modules.gaussian_actor`.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    spec = box_action(who.action(), needs_bounds=True)
    body, space = trunk(who, hidden, activation, normalizer, encoder), cast(Any, spec.space)
    head = who.linear(body.features, spec.shape[0], 0.01)
    squash = Squash(space.low, space.high).to(next(head.parameters()).device)
    return headed(body, nn.Sequential(head, squash), [who.key("action")])


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
