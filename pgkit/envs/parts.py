"""The parts of an observation that hold numbers: found in its space, checked, and joined to one vector."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import prod
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

Path = tuple[Any, ...]  # names in a Dict, positions in a Tuple


def numbers(x: Any, shape: tuple[int, ...]) -> np.ndarray:
    """``x`` as an array.

    Raises:
        ValueError: it has another shape, or holds something else than real numbers.
    """
    array = x if type(x) is np.ndarray else np.asarray(x)
    if array.shape != shape:
        raise ValueError(f"shape {array.shape}, its space says {shape}")
    if array.dtype.kind not in "fiub":
        raise ValueError(f"type {array.dtype}, its space says numbers")
    return array


def leaves(space: gym.Space, path: Path = ()) -> Iterator[tuple[Path, gym.Space]]:
    """The spaces inside Dicts and Tuples, in the order of ``gymnasium.spaces.flatten``."""
    if isinstance(space, spaces.Dict):
        for name, part in space.spaces.items():
            yield from leaves(part, (*path, name))
    elif isinstance(space, spaces.Tuple):
        for position, part in enumerate(space.spaces):
            yield from leaves(part, (*path, position))
    else:
        yield path, space


def reader(space: gym.Space) -> Callable[[Any], Any] | None:
    """From what an environment returns for this space to its numbers, one vector; None where it holds none."""
    if isinstance(space, spaces.Box | spaces.MultiBinary):
        return partial(_flat, space.shape)
    if isinstance(space, spaces.Discrete):
        return partial(_one_hot, np.array([space.n]), np.array([space.start]), ())
    if isinstance(space, spaces.MultiDiscrete):
        return partial(_one_hot, space.nvec.ravel(), space.start.ravel(), space.shape)
    return partial(spaces.flatten, space) if isinstance(space, spaces.OneOf) else None


def _flat(shape: tuple[int, ...], x: Any) -> np.ndarray:
    return numbers(x, shape).ravel()


def _one_hot(sizes: np.ndarray, start: np.ndarray, shape: tuple[int, ...], x: Any) -> np.ndarray:
    """Of each number, which of ``sizes`` it is, counted from ``start``."""
    place = numbers(x, shape).ravel() - start
    if place.dtype.kind not in "iu" or (place < 0).any() or (place >= sizes).any():
        raise ValueError(f"{x!s:.60}, its space says whole numbers from {start} to {start + sizes - 1}")
    out = np.zeros(sizes.sum(), np.float32)
    out[np.cumsum(sizes) - sizes + place] = 1.0
    return out


class Joined:
    """Reads the parts of an observation as one vector.

    Args:
        found: their paths and spaces, of :func:`leaves`.
    """

    def __init__(self, found: Sequence[tuple[Path, gym.Space]]) -> None:
        self._read: Any = [(path, reader(space)) for path, space in found]
        self._spaces = found
        self.is_arrays = all(isinstance(space, spaces.Box | spaces.MultiBinary) for _, space in found)
        self.size = sum(spaces.flatdim(space) for _, space in found)

    def __call__(self, obs: Any) -> np.ndarray:
        """``[size]`` of one observation."""
        return np.concatenate([read(_at(obs, path)) for path, read in self._read])

    def all(self, obs: Any) -> np.ndarray:
        """``[N, size]`` of a batch of observations; of arrays only."""
        found = [(np.asarray(_at(obs, path)), space.shape or ()) for path, space in self._spaces]
        rows = len(found[0][0])
        return np.concatenate([numbers(x, (rows, *shape)).reshape(rows, prod(shape)) for x, shape in found], 1)


def _at(obs: Any, path: Path) -> Any:
    for name in path:
        obs = obs[name]
    return obs
