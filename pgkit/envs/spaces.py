"""Gymnasium's spaces as TorchRL's specs, and how observations and actions cross from one to the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, TensorSpec, Unbounded

from pgkit.envs import parts
from pgkit.envs.once import warn_once
from pgkit.errors import UserError

TAKEN = (
    "action", "action_log_prob", "reward", "done", "terminated", "truncated", "next", "is_init", "recurrent_state",
    "episode_reward", "step_count", "advantage", "value_target", "state_value", "loc", "scale", "logits", "collector",
)  # fmt: skip


class Entry(NamedTuple):
    """One entry of a rollout's observation.

    Attributes:
        key: its name.
        shape: of one observation, without the environments.
        dtype: NumPy's, which it is stored in.
        read: the entry of what an environment returned.
        read_all: the same for a batch of ``N`` observations, ``[N, *shape]``; None: row by row.
    """

    key: str
    shape: tuple[int, ...]
    dtype: Any
    read: Callable[[Any], Any]
    read_all: Callable[[Any], Any] | None

    def spec(self, num_envs: int) -> TensorSpec:
        """TorchRL's spec of ``num_envs`` observations."""
        shape = torch.Size((num_envs, *self.shape))
        if self.dtype is np.bool_:
            return Binary(shape=shape, dtype=torch.bool)
        if self.dtype is np.uint8:
            return Bounded(0, 255, shape, dtype=torch.uint8)
        return Unbounded(shape, dtype=torch.from_numpy(np.zeros(1, self.dtype)).dtype)


def observation_entries(space: gym.Space, flatten: bool = True) -> list[Entry]:
    """The entries that an observation of ``space`` becomes, all ``observation`` unless ``flatten`` is False.

    Images (uint8 of two dimensions and more) keep their type; all else that is one vector is float32. What holds no
    numbers (text, sequences, another library's spaces) is left out, with a warning.

    Raises:
        UserError: the space holds no numbers; or with ``flatten=False``, it is no Dict, or an entry has a name
            that rollouts use.
    """
    if not flatten:
        return _apart(space)
    if isinstance(space, spaces.Box):
        image = space.dtype == np.uint8 and len(space.shape) > 1
        return [_box("observation", space, np.uint8 if image else np.float32, itself)]
    if isinstance(space, spaces.Text):  # by itself
        return [Entry("observation", (spaces.flatdim(space),), np.float32, partial(spaces.flatten, space), None)]
    return [_flat("observation", space, itself, apart="envs.make(..., flatten=False) keeps it apart")]


def _apart(space: gym.Space) -> list[Entry]:
    """Each entry of a Dict under its own name and in its own type; what is discrete becomes one-hot."""
    if not isinstance(space, spaces.Dict):
        raise UserError(
            f"flatten=False keeps the entries of a Dict observation apart, this one is {space}: leave it out"
        )
    if taken := [name for name in space if name in TAKEN]:
        raise UserError(f"the observation's entry '{taken[0]}' has a name that rollouts use: rename it in a wrapper")
    numeric = [name for name in space if any(parts.reader(leaf) for _, leaf in parts.leaves(space[name]))]
    _say_left_out(space, [name for name in space if name not in numeric], bool(numeric))
    entries = []
    for name in numeric:
        part, get = space[name], itemgetter(name)
        if isinstance(part, spaces.Box):
            dtype = np.float32 if np.issubdtype(part.dtype, np.floating) else part.dtype.type
            entries.append(_box(name, part, dtype, get))
        elif isinstance(part, spaces.MultiBinary):
            entries.append(Entry(name, part.shape, np.bool_, get, get))
        else:
            entries.append(_flat(name, part, get, apart="lift it to the top of the Dict in a wrapper"))
    return entries


def _flat(name: str, space: gym.Space, get: Callable[[Any], Any], apart: str) -> Entry:
    """All numbers of a space as one vector, in the order of ``gymnasium.spaces.flatten``."""
    leaves = [(path, leaf) for path, leaf in parts.leaves(space) if parts.reader(leaf) is not None]
    _say_left_out(space, [path for path, leaf in parts.leaves(space) if (path, leaf) not in leaves], bool(leaves))
    named = {".".join(map(str, path)): leaf for path, leaf in leaves}
    for path, leaf in named.items():
        if path and isinstance(leaf, spaces.Box) and len(leaf.shape) > (1 if leaf.dtype == np.uint8 else 2):
            warn_once(f"the observation's image '{path}' is flattened with the rest: {apart}")
    if "action_mask" in named:
        warn_once(
            "the observation's action_mask is flattened with the rest and masks nothing: envs.make(..., flatten=False) "
            "keeps it apart"
        )
    joined = parts.Joined(leaves)
    read_all = partial(_nested, joined.all, get) if joined.is_arrays else None
    return Entry(name, (joined.size,), np.float32, joined if get is itself else partial(_nested, joined, get), read_all)


def _say_left_out(space: gym.Space, left_out: Sequence[Any], some_stay: bool) -> None:
    if not some_stay:
        raise UserError(
            f"the observation space {space!s:.200} holds no numbers and cannot become one vector: "
            "encode it in a wrapper"
        )
    for path in left_out:
        name = path if isinstance(path, str) else ".".join(map(str, path))
        warn_once(f"the observation's entry '{name}' holds no numbers and is left out: encode it in a wrapper")


def _box(name: str, space: spaces.Box, dtype: Any, get: Callable[[Any], Any]) -> Entry:
    if space.shape:
        return Entry(name, space.shape, dtype, get, get)
    return Entry(name, (1,), dtype, partial(_lifted, get), None)


def itself(obs: Any) -> Any:
    return obs


def _nested(read: Callable[[Any], Any], get: Callable[[Any], Any], obs: Any) -> Any:
    return read(get(obs))


def _lifted(get: Callable[[Any], Any], obs: Any) -> Any:
    """A single number as a vector of one."""
    return parts.numbers(get(obs), ()).reshape(1)


@dataclass(frozen=True)
class ToEnv:
    """A policy's actions ``[B, ...]`` as one environment takes them: clipped, rounded, of its type, from its start.

    ``low`` and ``high`` are the bounds of a Box, else None. The result shares no memory with what is given.
    """

    low: np.ndarray | None = None
    high: np.ndarray | None = None
    dtype: Any = None
    start: Any = 0

    def __call__(self, actions: np.ndarray) -> np.ndarray:
        if self.low is not None and self.high is not None:
            clipped = np.minimum(np.maximum(actions, self.low), self.high)
            rounded = np.rint(clipped) if self.dtype.kind in "iu" else clipped
            return rounded.astype(self.dtype, copy=False)
        return actions.astype(self.dtype) if self.dtype is not None else np.add(actions, self.start)


def to_env(space: gym.Space) -> ToEnv:
    """The converter for an action space."""
    if isinstance(space, spaces.Box):
        return ToEnv(space.low, space.high, space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return ToEnv(dtype=space.dtype)
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        return ToEnv(start=space.start)
    raise _not_supported(space)


def action_spec(space: gym.Space, num_envs: int) -> TensorSpec:
    """TorchRL's spec of ``num_envs`` actions of a Gymnasium space: ``[num_envs, dim]``, discrete ``[num_envs]``."""
    if isinstance(space, spaces.Box):
        low, high = (torch.as_tensor(x, dtype=torch.float32) for x in (space.low, space.high))
        shape = torch.Size((num_envs, *space.shape))
        if not shape.numel():
            raise UserError(
                f"the action space has shape {space.shape}, which leaves nothing to decide: give one action"
            )
        if not (low.isfinite().all() and high.isfinite().all()):
            return Unbounded(shape, dtype=torch.float32)
        return Bounded(low.expand(shape), high.expand(shape), shape, dtype=torch.float32)
    if isinstance(space, spaces.Discrete):
        return Categorical(int(space.n), shape=(num_envs,))
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary) and len(space.shape) != 1:
        raise UserError(
            f"the action space, {type(space).__name__}, has shape {space.shape}, actions are vectors: flatten it"
        )
    if isinstance(space, spaces.MultiDiscrete):
        return MultiCategorical(space.nvec.tolist(), shape=(num_envs, len(space.nvec)))
    if isinstance(space, spaces.MultiBinary):
        return MultiCategorical([2] * space.shape[0], shape=(num_envs, space.shape[0]))
    raise _not_supported(space)


def _not_supported(space: gym.Space) -> UserError:
    return UserError(f"action space {space!s:.100} is not supported: Box, Discrete, MultiDiscrete and MultiBinary are")
