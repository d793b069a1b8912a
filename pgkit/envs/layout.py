"""How the entries of a Dict observation lie in one flat vector."""

from __future__ import annotations

from typing import NamedTuple

import torch
from gymnasium import spaces
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from pgkit.errors import UserError

TAKEN = (
    "action", "action_log_prob", "reward", "done", "terminated", "truncated", "next", "is_init", "recurrent_state",
    "episode_reward", "step_count", "advantage", "value_target", "state_value", "loc", "scale", "logits",
)  # fmt: skip


class Entry(NamedTuple):
    """One entry: its columns, its shape, and whether it is boolean."""

    start: int
    end: int
    shape: tuple[int, ...]
    flag: bool


class Layout(dict[str, Entry]):
    """Called with flat observations ``[*B, size]``, it returns the entries ``{name: [*B, *shape]}``, as views.

    A Box keeps its shape, MultiBinary is boolean (an action mask), all else is a vector, one-hot where it is discrete.
    """

    def __call__(self, obs: Tensor) -> dict[str, Tensor]:
        parts = {name: obs[..., e.start : e.end].unflatten(-1, e.shape) for name, e in self.items()}
        return {name: x.bool() if self[name].flag else x for name, x in parts.items()}

    def spec(self, num_envs: int) -> Composite:
        """TorchRL's spec of ``num_envs`` observations."""
        made: dict[str, TensorSpec] = {}
        for name, entry in self.items():
            shape = (num_envs, *entry.shape)
            made[name] = Binary(shape=shape, dtype=torch.bool) if entry.flag else Unbounded(shape, dtype=torch.float32)
        return Composite(made, shape=(num_envs,))


def layout(space: spaces.Space) -> Layout:
    """The layout of a Dict space in the vector that ``gymnasium.spaces.flatten`` makes of its observations.

    Raises:
        UserError: the space is no Dict, or an entry has a name that rollouts use.
    """
    if not isinstance(space, spaces.Dict):
        raise UserError(
            f"flatten=False keeps the entries of a Dict observation apart, this one is {space}: leave it out"
        )
    taken = [name for name in space if name in TAKEN]
    if taken:
        raise UserError(f"the observation's entry '{taken[0]}' has a name that rollouts use: rename it in a wrapper")
    made, start = Layout(), 0
    for name, part in space.items():
        size = spaces.flatdim(part)
        shape = part.shape if isinstance(part, spaces.Box) and part.shape else (size,)
        made[name] = Entry(start, start + size, shape, isinstance(part, spaces.MultiBinary))
        start += size
    return made
