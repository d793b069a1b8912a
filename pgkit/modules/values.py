"""Value operators: state values, as TorchRL's ``ValueOperator``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import ValueOperator

from pgkit.modules.groups import Share, agents
from pgkit.modules.trunk import Centralized, headed, trunk


def state_value(
    env: EnvBase,
    hidden: Sequence[int] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    *,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    centralized: Centralized = False,
    device: torch.device | str | None = None,
) -> ValueOperator:
    """A state value: ``observation [*B, obs] -> state_value [*B, 1]``. Arguments as in :func:`gaussian_actor`.

    An ``encoder`` shared with the actor is trained by the sum of all losses; ``separate_losses=True`` in the loss
    leaves it to the policy loss alone. Of a group, the values are ``("agents", "state_value") [*B, agents, 1]``.

    Args:
        centralized: True: every agent's value is of all agents' observations side by side; or the key of a state that
            all agents share, ``[*B, size]``.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    body = trunk(who, hidden, activation, normalizer, encoder, centralized)
    head = who.linear(body.features, 1, 1.0)
    net = headed(body, head, [who.key("state_value")], states=False)
    return ValueOperator(net.module, in_keys=net.in_keys, out_keys=net.out_keys)
