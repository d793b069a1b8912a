"""What a group of agents observes, gains and ends with: arrays, and tensors of the same memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from pgkit.envs.agents import Group
from pgkit.envs.checks import checked_flag, checked_reward
from pgkit.envs.parts import numbers
from pgkit.envs.spaces import ToEnv, to_env
from pgkit.seams import Entries


class Rows:
    """What a group observes, ``[N, A, ...]``: arrays, and tensors of the same memory by key."""

    def __init__(self, group: Group, num_envs: int) -> None:
        self.arrays = {name: spec.zero().numpy() for name, spec in group.observation_spec(num_envs).items()}
        self.arrays["mask"] = np.zeros((num_envs, len(group.members)), bool)
        self.tensors: Entries = {(group.name, name): torch.from_numpy(x) for name, x in self.arrays.items()}

    def copy_from(self, other: Rows) -> None:
        for name, x in self.arrays.items():
            x[...] = other.arrays[name]

    def copy_row(self, other: Rows, i: int) -> None:
        for name, x in self.arrays.items():
            x[i] = other.arrays[name][i]


class Team:
    """The arrays of a group: what its agents observe now and next, and how a step ended for each."""

    def __init__(self, group: Group, num_envs: int) -> None:
        self.name, self.members, self.group = group.name, group.members, group
        self.to_env: ToEnv = to_env(group.action)
        self.fresh, self.next = Rows(group, num_envs), Rows(group, num_envs)
        shape = (num_envs, len(group.members), 1)
        self.reward, self.total = np.zeros(shape, np.float32), np.zeros(shape)
        self.terminated, self.truncated = np.zeros(shape, bool), np.zeros(shape, bool)

    def observe(self, rows: Rows, i: int, observations: dict[str, Any], present: Sequence[str]) -> None:
        """Writes row ``i``: what each agent observes, the last of those that are gone; whether it acts next."""
        for place, name in enumerate(self.members):
            there = name in present
            rows.arrays["mask"][i, place] = there
            seen = observations[name] if there else observations.get(name)
            if "action_mask" in rows.arrays:
                rows.arrays["action_mask"][i, place] = True if seen is None else seen["action_mask"]
                seen = None if seen is None else seen["observation"]
                if not rows.arrays["action_mask"][i, place].any() and not there:
                    rows.arrays["action_mask"][i, place] = True  # of one that does not act any more
            entry = self.group.observation
            gone = seen is None and not there
            rows.arrays["observation"][i, place] = 0 if gone else numbers(entry.read(seen), entry.shape)

    def write(self, env: Any, i: int, acting: set[str], reward: dict, terminated: dict, truncated: dict) -> None:
        """Writes the rewards and flags of row ``i``; agents that are gone stay terminated, or cut off."""
        for place, name in enumerate(self.members):
            acted = name in acting
            self.reward[i, place] = checked_reward(env, reward[name]) if acted else 0.0
            self.terminated[i, place] = checked_flag(env, "terminated", terminated[name]) if acted else True
            self.truncated[i, place] = checked_flag(env, "truncated", truncated[name]) if acted else False
        self.total[i] += self.reward[i]
