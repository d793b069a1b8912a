"""Groups of agents: who is in which, and the specs of a vector of environments with them, in TorchRL's layout."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import gymnasium as gym
import torch
from gymnasium import spaces
from torchrl.data import Categorical, Composite, TensorSpec, Unbounded

from pgkit.envs.spaces import TAKEN, Entry, action_spec, observation_entries
from pgkit.errors import UserError

Names = Mapping[str, Sequence[str]]


class Group(NamedTuple):
    """Agents whose entries lie side by side.

    Attributes:
        name: what their entries lie under.
        members: names of the agents, in order.
        observation: what one of them observes, without an action mask.
        action: the space of one agent's action.
        masked: whether an observation is a Dict with an ``action_mask`` beside it (PettingZoo's convention).
    """

    name: str
    members: tuple[str, ...]
    observation: Entry
    action: gym.Space
    masked: bool

    def observation_spec(self, num_envs: int) -> dict[str, TensorSpec]:
        """Specs ``[N, A, ...]`` of what the group observes."""
        found = {"observation": self._many(self.observation.spec(num_envs))}
        if self.masked:
            size = (num_envs, len(self.members), int(spaces.flatdim(self.action)))
            found["action_mask"] = Categorical(2, size, dtype=torch.bool)
        return found

    def action_spec(self, num_envs: int) -> TensorSpec:
        """Spec ``[N, A, ...]`` of the group's actions."""
        return self._many(action_spec(self.action, num_envs))

    def _many(self, spec: TensorSpec) -> TensorSpec:
        return spec.unsqueeze(1).expand(spec.shape[0], len(self.members), *spec.shape[1:])


def groups_of(
    kind: str,
    observations: Mapping[str, gym.Space],
    actions: Mapping[str, gym.Space],
    wanted: Names | None = None,
) -> list[Group]:
    """The groups of agents with these spaces.

    Agents whose spaces are all equal are one group, ``agents``. Else agents are grouped by their names, ``speaker_0``
    into ``speaker``, as TorchRL does.

    Args:
        kind: what messages call the environment.
        observations, actions: spaces by the agent's name.
        wanted: other groups: names of agents by the name of their group.

    Raises:
        UserError: unequal spaces in one group, agents that are in no group or in two, a name that rollouts use.
    """
    agents = list(observations)
    first = agents[0]
    equal = all(observations[x] == observations[first] and actions[x] == actions[first] for x in agents)
    if wanted is not None:
        _check(kind, agents, wanted)
    elif equal:
        wanted = {"agents": agents}
    else:
        prefixes = [re.sub(r"_\d+$", "", name) for name in agents]
        wanted = {x: [a for a, p in zip(agents, prefixes, strict=True) if p == x] for x in dict.fromkeys(prefixes)}
    return [_group(kind, name, list(members), observations, actions) for name, members in wanted.items()]


def _check(kind: str, agents: Sequence[str], wanted: Names) -> None:
    grouped = [agent for members in wanted.values() for agent in members]
    if unknown := [x for x in grouped if x not in agents]:
        raise UserError(f"groups=: {kind} has no agent '{unknown[0]}', only {', '.join(agents)}")
    if wrong := [x for x in agents if grouped.count(x) != 1]:
        raise UserError(
            f"groups=: agent '{wrong[0]}' of {kind} is in {grouped.count(wrong[0])} groups: put it into one"
        )


def _group(
    kind: str, name: str, members: list[str], observations: Mapping[str, gym.Space], actions: Mapping[str, gym.Space]
) -> Group:
    if name in TAKEN:
        raise UserError(f"the group '{name}' has a name that rollouts use: envs.make(..., groups={{'agents': [...]}})")
    first = members[0]
    for what, found in (("observe", observations), ("act in", actions)):
        if other := [x for x in members if found[x] != found[first]]:
            raise UserError(
                f"group '{name}': {first} and {other[0]} {what} different spaces ({found[first]}, {found[other[0]]}), "
                f"one network needs equal ones: give them groups of their own, groups={{...}}, or pad them in a wrapper"
            )
    space, masked = observations[first], False
    if isinstance(space, spaces.Dict) and set(space.spaces) == {"observation", "action_mask"}:
        space, masked = space["observation"], True
    (entry,) = observation_entries(space)
    return Group(name, tuple(members), entry, actions[first], masked)


def under(groups: Sequence[Group], num_envs: int, entries: Mapping[str, Mapping[str, TensorSpec]]) -> Composite:
    """A spec ``[N]`` with these entries under each group's name, ``[N, A, ...]``."""
    made = {g.name: Composite(dict(entries[g.name]), shape=(num_envs, len(g.members))) for g in groups}
    return Composite(made, shape=(num_envs,))


def rewards(groups: Sequence[Group], num_envs: int) -> Composite:
    """A reward for each agent, ``[N, A, 1]``."""
    made = {g.name: {"reward": Unbounded((num_envs, len(g.members), 1), dtype=torch.float32)} for g in groups}
    return under(groups, num_envs, made)
