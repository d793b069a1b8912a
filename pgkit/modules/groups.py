"""One agent or a group of them: keys, sizes, and which agents share parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec

from pgkit.errors import UserError
from pgkit.modules.ensemble import EnsembleLinear
from pgkit.modules.mlp import orthogonal
from pgkit.modules.sizes import action_spec, groups, observation_spec, spec_device

Share = bool | Sequence[int] | Mapping[Any, int]


@dataclass(frozen=True)
class Agents:
    """Who a network is for: a single agent (``name`` None), or a group, whose entries have a dimension of agents.

    Attributes:
        env: any environment with TorchRL's specs.
        name: the group's, the first part of its keys.
        number: of agents.
        sets: for each agent, which set of parameters is its own.
        ids: give each agent its number as a one-hot input.
        device: where modules are built.
    """

    env: Any
    name: str | None
    number: int
    sets: tuple[int, ...]
    ids: bool
    device: torch.device | None

    def key(self, name: str) -> NestedKey:
        """``name``, of a group below its own."""
        return name if self.name is None else (self.name, name)

    def observation(self, key: NestedKey) -> TensorSpec:
        """Spec of one observation, of one agent where the entry is the group's."""
        return self._own(observation_spec(self.env, key), key)

    def action(self) -> TensorSpec:
        """Spec of one agent's action."""
        return self._own(action_spec(self.env, self.key("action")), self.key("action"))

    def linear(self, inputs: int, outputs: int, gain: float | None = None) -> nn.Module:
        """A linear layer ``[*B, inputs]`` to ``[*B, outputs]``; of a group ``[*B, agents, ...]``.

        Orthogonal weights times ``gain`` and a bias of zero; without a gain, torch's initialization.
        """
        if self.several:
            layer = AgentLinear(self.sets, inputs, outputs, gain or 1.0)
            for parameter in [] if gain else layer.parameters():
                nn.init.uniform_(parameter, -(inputs**-0.5), inputs**-0.5)
        else:
            layer = nn.Linear(inputs, outputs)
            layer = orthogonal(layer, gain) if gain else layer
        return layer.to(self.device)

    @property
    def several(self) -> bool:
        """Whether there is more than one set of parameters."""
        return max(self.sets, default=0) > 0

    def _own(self, spec: Any, key: NestedKey) -> TensorSpec:
        mine = self.name is not None and not isinstance(key, str) and key[0] == self.name
        return spec[0] if mine else spec


def agents(
    env: Any,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    device: torch.device | str | None = None,
) -> Agents:
    """Reads who a network is for off the specs; the only group of an environment without a root observation is found.

    Args:
        env: any environment with TorchRL's specs.
        group: name of a group of agents.
        share_parameters: one set of parameters for all agents (True), one for each (False), or each agent's number
            of a set: a sequence, or a mapping in the agents' order.
        agent_ids: each agent's number is an input.
        device: by default the specs'.

    Raises:
        UserError: no such group, several to choose from, sets that do not fit, or group settings without a group.
    """
    spec_device(env)  # a UserError for what is no environment
    names, known = groups(env), env.observation_spec
    if group is None and "observation" not in known.keys() and names:
        if len(names) > 1:
            raise UserError(f"the environment has the groups {', '.join(names)}: say which, group='{names[0]}'")
        group = names[0]
    device = torch.device(device) if device is not None else spec_device(env)
    if group is None:
        if agent_ids or share_parameters is not True:
            raise UserError("share_parameters= and agent_ids= are for a group of agents, the environment has one agent")
        return Agents(env, None, 1, (), False, device)
    if group not in names:
        raise UserError(f"the environment has no group '{group}', only {', '.join(names) or 'one agent'}")
    number = action_spec(env, (group, "action")).shape[0]
    return Agents(env, group, number, _sets(share_parameters, number), agent_ids, device)


def _sets(share: Share, number: int) -> tuple[int, ...]:
    if isinstance(share, bool):
        return (0,) * number if share else tuple(range(number))
    sets = tuple(share.values() if isinstance(share, Mapping) else share)
    if len(sets) != number or set(sets) != set(range(max(sets, default=0) + 1)):
        raise UserError(
            f"share_parameters={share}: give the number of a set, from 0 on and none left out, for each of the "
            f"{number} agents"
        )
    return sets


class AgentLinear(EnsembleLinear):
    """Linear layers of several sets of parameters, ``[*B, agents, in]`` to ``[*B, agents, out]``, as one ``bmm``."""

    def __init__(self, sets: Sequence[int], inputs: int, outputs: int, gain: float) -> None:
        super().__init__(max(sets) + 1, inputs, outputs, gain)
        self.sets = None if list(sets) == [*range(len(sets))] else list(sets)

    def forward(self, x: Tensor) -> Tensor:
        assert self.bias is not None
        own = [p if self.sets is None else torch.stack([p[i] for i in self.sets]) for p in (self.weight, self.bias)]
        first = x.movedim(-2, 0)  # a layer after another finds it contiguous
        out = torch.bmm(first.reshape(len(first), -1, x.shape[-1]), own[0]) + own[1]
        return out.reshape(*first.shape[:-1], out.shape[-1]).movedim(0, -2)


class AgentIds(nn.Module):
    """``[*B, agents, features]`` with each agent's number as a one-hot, ``[*B, agents, features + agents]``."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    def forward(self, x: Tensor) -> Tensor:
        ids = torch.eye(self.number, dtype=x.dtype, device=x.device)
        return torch.cat([x, ids.expand(*x.shape[:-2], -1, -1)], -1)


class AllAgents(nn.Module):
    """What a centralized critic reads: the same features for all agents, ``[*B, copies, features]``.

    Args:
        copies: 1, or the number of agents where each of them has a value of its own.
        flatten: the input is all agents' features ``[*B, agents, f]``, which stand side by side; False: ``[*B, f]``.
    """

    def __init__(self, copies: int, flatten: bool) -> None:
        super().__init__()
        self.copies, self.flatten = copies, flatten

    def forward(self, x: Tensor) -> Tensor:
        x = x.flatten(-2) if self.flatten else x
        return x.unsqueeze(-2).expand(*x.shape[:-1], self.copies, -1)


class ForEachAgent(nn.Module):
    """One value for all agents as one for each, ``[*B, 1, size]`` to ``[*B, agents, size]``."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    def forward(self, x: Tensor) -> Tensor:
        return x.expand(*x.shape[:-2], self.number, -1)
