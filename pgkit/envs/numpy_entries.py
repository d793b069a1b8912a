"""What the NumPy simulators write a step's observations and infos into: arrays, seen as tensors of the same memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector.utils import iterate
from torch import Tensor
from torchrl.data import Categorical, Composite, TensorSpec, Unbounded

from pgkit.envs.parts import numbers
from pgkit.envs.spaces import TAKEN, Entry, itself
from pgkit.errors import UserError
from pgkit.seams import Entries, Key

Info: TypeAlias = Sequence[Key] | Mapping[Key, TensorSpec]


class Observations:
    """Arrays ``[N, ...]`` of observations, one for each entry; ``tensors`` is the same memory."""

    def __init__(self, entries: Sequence[Entry], num_envs: int) -> None:
        self.entries = entries
        self.arrays = [np.zeros((num_envs, *entry.shape), entry.dtype) for entry in entries]
        self.tensors: Entries = {entry.key: torch.from_numpy(x) for entry, x in zip(entries, self.arrays, strict=True)}
        self._columns = [(entry.read, x, entry.shape) for entry, x in zip(entries, self.arrays, strict=True)]

    def write(self, row: int, obs: Any) -> None:
        """Writes what one environment returned; ``ValueError`` where it is not of its space."""
        for read, array, shape in self._columns:
            array[row] = numbers(obs if read is itself else read(obs), shape)

    def write_all(self, obs: Any, space: gym.Space) -> None:
        """Writes a batch of observations of a batched ``space``."""
        for entry, array in zip(self.entries, self.arrays, strict=True):
            if entry.read_all is not None:
                array[...] = numbers(entry.read_all(obs), array.shape)
            else:
                for row, one in enumerate(iterate(space, obs)):
                    array[row] = numbers(entry.read(one), entry.shape)

    def copy_from(self, other: Observations) -> None:
        """Takes over every entry of ``other``."""
        for mine, theirs in zip(self.arrays, other.arrays, strict=True):
            mine[...] = theirs


class Infos:
    """Arrays of the ``info`` entries that were asked for; where a step has none, NaN, or 0 for whole numbers.

    Args:
        wanted: names of single numbers, or a mapping from names to TorchRL specs of one environment; ``episode`` is
            what ``gymnasium.wrappers.RecordEpisodeStatistics`` writes, its return ``r`` and length ``l``.
    """

    def __init__(self, wanted: Info, num_envs: int) -> None:
        wanted = [wanted] if isinstance(wanted, str) else wanted
        if not isinstance(wanted, Sequence | Mapping) or not all(isinstance(key, str | tuple) for key in wanted):
            raise UserError(f"info={wanted!r:.60}: give names of entries, info=('is_success',)")
        specs = dict(wanted) if isinstance(wanted, Mapping) else dict.fromkeys(wanted, None)
        if taken := [key for key in specs if as_path(key)[0] in TAKEN]:
            raise UserError(f"info={taken[0]!r}: rollouts have an entry of that name: rename it in a wrapper")
        if "episode" in specs:
            del specs["episode"]
            specs |= {("episode", "r"): None, ("episode", "l"): None}
        made = {key: spec or Unbounded((1,), dtype=torch.float32) for key, spec in specs.items()}
        batched = {key: spec.unsqueeze(0).expand(num_envs, *spec.shape) for key, spec in made.items()}
        self.spec = Composite(batched, shape=(num_envs,))
        self.tensors: Entries = {key: spec.zero() for key, spec in batched.items()}
        self._arrays = [(as_path(key), x.numpy()) for key, x in self.tensors.items()]

    def clear(self) -> None:
        """Before a step: no entry is there."""
        for _, array in self._arrays:
            array[...] = np.nan if array.dtype.kind == "f" else 0

    def write(self, row: int, info: Any) -> None:
        """Writes the entries that one environment's ``info`` has."""
        for path, array in self._arrays:
            value = _found(info, path)
            if value is not None:
                array[row] = _as_info(path, value, array.shape[1:])

    def write_all(self, info: Any, only: np.ndarray | None = None) -> None:
        """Writes the entries of a vector's ``info``, where it has them (Gymnasium's ``_name`` says where)."""
        for path, array in self._arrays:
            value, where = _found(info, path), _found(info, (*path[:-1], f"_{path[-1]}"))
            if value is not None:
                rows = np.ones(len(array), bool) if where is None else np.asarray(where, bool)
                rows = rows if only is None else rows & only
                values = np.asarray(value)[rows]
                array[rows] = _as_info(path, values, (len(values), *array.shape[1:]))


def _as_info(path: tuple[str, ...], value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An entry of ``info`` as an array of this shape; one number may lack the 1 at the end."""
    x = np.asarray(value)
    if x.shape not in (shape, shape[:-1]) or x.dtype.kind not in "fiub":
        raise UserError(
            f"info={'.'.join(path)!r} is {value!r:.60}: name entries that are single numbers, or give their TorchRL "
            "specs, info={name: Unbounded(shape)}"
        )
    return x.reshape(shape)


def as_path(key: Key) -> tuple[str, ...]:
    """A nested key as a tuple."""
    return (key,) if isinstance(key, str) else key


def _found(info: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        if not isinstance(info, Mapping) or name not in info:
            return None
        info = info[name]
    return info


class Totals:
    """Rewards and flags of a step, return and length of the episodes that run; ``[N]`` arrays, ``[N, 1]`` tensors."""

    def __init__(self, num_envs: int) -> None:
        self.reward = np.zeros(num_envs, np.float32)
        self.terminated, self.truncated = np.zeros(num_envs, bool), np.zeros(num_envs, bool)
        self.episode_reward, self.step_count = np.zeros(num_envs), np.zeros(num_envs, np.int64)
        self.rewards: Entries = {"reward": _column(self.reward)}
        self.ends: Entries = {"terminated": _column(self.terminated)}
        self.cuts: Entries = {"truncated": _column(self.truncated)}
        self.returns: Entries = {"reward": _column(self.episode_reward)}
        self.steps = torch.from_numpy(self.step_count)

    def forget(self, rows: np.ndarray) -> None:
        """New episodes begin in these rows."""
        self.episode_reward[rows] = 0.0
        self.step_count[rows] = 0

    def count(self) -> None:
        """Adds the step that ``reward`` belongs to."""
        self.episode_reward += self.reward
        self.step_count += 1


def _column(array: np.ndarray) -> Tensor:
    return torch.from_numpy(array).unsqueeze(-1)


def flags(num_envs: int) -> Composite:
    """The ``done_spec`` of environments that end each by itself."""
    flag = Categorical(2, shape=(num_envs, 1), dtype=torch.bool)
    return Composite(done=flag, terminated=flag, truncated=flag, shape=(num_envs,))


def rewards(num_envs: int) -> Composite:
    """The ``reward_spec`` of one number an environment."""
    return Composite(reward=Unbounded((num_envs, 1), dtype=torch.float32), shape=(num_envs,))
