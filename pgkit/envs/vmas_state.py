"""VMAS's environments: the state that they keep, and their random numbers."""

from __future__ import annotations

import difflib
import random
from collections.abc import Callable
from types import TracebackType
from typing import Any

import numpy as np
import torch

from pgkit.envs.held import Slot, walk
from pgkit.errors import UserError


def slots(env: Any) -> list[Slot]:
    """Every tensor and number that an environment of VMAS and its world, scenario and entities hold."""
    own = {"vmas", type(env.scenario).__module__.partition(".")[0]}
    return list(walk(env, own))


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
