"""Where VMAS's objects keep their state: every tensor and number, by the path that leads to it; its random numbers."""

from __future__ import annotations

import difflib
import random
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from pgkit.errors import UserError

Slot: TypeAlias = tuple[str, Any, Any, Any]  # path, the object, list or dict that holds it, its name there, its value


def slots(env: Any) -> list[Slot]:
    """Every tensor and number that an environment of VMAS and its world, scenario and entities hold."""
    own = {"vmas", type(env.scenario).__module__.partition(".")[0]}
    return list(walk(env, own))


def walk(owner: Any, own: set[str], path: str = "", seen: set[int] | None = None) -> Iterator[Slot]:
    """Every tensor and number that an object holds, and what it holds of the packages ``own``, lists and dicts too."""
    seen = set() if seen is None else seen
    seen.add(id(owner))
    if isinstance(owner, list | tuple):
        items = list(enumerate(owner))
    else:
        items = list((owner if isinstance(owner, dict) else vars(owner)).items())
    for place, (name, x) in enumerate(items):
        here = f"{path}.{name if isinstance(name, str) else place}"  # a dict's keys may be entities
        if isinstance(x, Tensor | bool | int | float):
            if not isinstance(owner, tuple):
                yield here, owner, name, x
        elif id(x) not in seen and (isinstance(x, dict | list | tuple) or type(x).__module__.partition(".")[0] in own):
            yield from walk(x, own, here, seen)


def put(slot: Slot, value: Any) -> None:
    """Gives a slot another value; a tensor keeps its memory, which others may share."""
    _, holder, name, now = slot
    if isinstance(now, Tensor) and isinstance(value, Tensor) and now.shape == value.shape and _is_dense(now):
        now.copy_(value)
    elif isinstance(holder, dict | list):
        holder[name] = value
    else:
        vars(holder)[name] = value


def _is_dense(x: Tensor) -> bool:
    """Whether no two elements share memory."""
    return all(size == 1 or stride > 0 for size, stride in zip(x.shape, x.stride(), strict=True))


class Stream:
    """``with stream:`` the global generators (torch's, NumPy's, Python's) are those of one object.

    All of VMAS's environments share one stream of random numbers, a list that their class holds: it gives each its
    first state, and what they draw from then on is their own.
    """

    def __init__(self, state: list[Any]) -> None:
        self.state = state

    @classmethod
    def of(cls, make: Callable[[], Any]) -> tuple[Any, Stream]:
        """An environment of VMAS's, and the stream that goes on where making it ended."""
        from vmas.simulator.environment import Environment

        shared: list[Any] = Environment.vmas_random_state
        others = list(shared)
        try:
            return make(), cls(list(shared))
        finally:
            shared[:] = others

    def __enter__(self) -> None:
        self._others = _generators()
        _set_generators(self.state)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.state = _generators()
        _set_generators(self._others)


def _generators() -> list[Any]:
    return [torch.get_rng_state(), np.random.get_state(), random.getstate()]


def _set_generators(state: list[Any]) -> None:
    torch.set_rng_state(state[0])
    np.random.set_state(state[1])
    random.setstate(state[2])


def make_function(scenario: Any) -> Any:
    """VMAS's function that makes an environment.

    Raises:
        UserError: VMAS is not installed, or there is no such scenario.
    """
    try:
        import vmas
    except ImportError as error:
        raise UserError(f'vmas/{scenario} needs VMAS ({error}): pip install "pgkit-rl[agents]"') from error
    known = [*vmas.scenarios, *vmas.debug_scenarios, *vmas.mpe_scenarios]
    if isinstance(scenario, str) and scenario not in known:
        nearest = ", ".join(f"vmas/{x}" for x in difflib.get_close_matches(scenario, known, cutoff=0.4) or known)
        raise UserError(f"unknown environment id 'vmas/{scenario}'; the nearest names are {nearest}")
    return vmas.make_env
