"""A simulator's step as native code: its state, which lies in attributes of objects, goes in and comes out."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from logging import getLogger
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from pgkit.compiled import Mode, compiled, every_branch
from pgkit.envs.held import Slot
from pgkit.errors import UserError

Function = Callable[..., Sequence[Tensor]]
Find = Callable[[], list[Slot]]
_MOST = 20_000  # operations that are worth compiling
_WORDS = {"advance": "the step", "renew": "the resets"}


class Call(NamedTuple):
    """What a function was given and did: state by path, the random numbers before it, and what no record holds."""

    inputs: list[Tensor]
    before: dict[str, Any]
    results: list[Tensor]
    after: dict[str, Any]
    random: Tensor
    wrong: str | None


def observed(function: Function, find: Find, calls: list[Call]) -> Function:
    """``function``, which notes its calls; ``find`` lists what it may change."""

    def call(*inputs: Tensor) -> Sequence[Tensor]:
        given, before = [x.clone() for x in inputs], _values(find())
        state, others = torch.get_rng_state(), (random.getstate(), np.random.get_state()[1:3])
        results = function(*inputs)
        after, now = _values(find()), (random.getstate(), np.random.get_state()[1:3])
        elsewhere = others[0] != now[0] or not np.array_equal(others[1][0], now[1][0]) or others[1][1] != now[1][1]
        wrong = "it draws random numbers of NumPy or Python, not torch's" if elsewhere else _rest_changed(before, after)
        calls.append(Call(given, before, [x.clone() for x in results], after, state, wrong))
        return results

    return call


def _values(slots: Iterable[Slot]) -> dict[str, Any]:
    return {path: x.clone() if isinstance(x, Tensor) else x for path, _, _, x in slots}


def _rest_changed(before: dict[str, Any], after: dict[str, Any]) -> str | None:
    """What changed besides the values of tensors, in words."""
    if moved := before.keys() ^ after.keys():
        return f"it makes or drops '{min(moved).strip('.')}'"
    for path, old in before.items():
        new, name = after[path], path.strip(".")
        if not isinstance(old, Tensor) or not isinstance(new, Tensor):
            if isinstance(old, Tensor) or isinstance(new, Tensor) or old != new:
                return f"it changes the number '{name}': a tensor would be recorded"
        elif old.shape != new.shape or old.dtype is not new.dtype:
            return f"'{name}' becomes another kind of tensor"
    return None


class Recorded:
    """A function of objects that keep their state in attributes, as native code.

    It is recorded on objects of its own, a twin; the state of any other objects like these goes in and comes back.

    Args:
        function: tensors in, tensors out; it changes the twin.
        find: lists what the twin holds.
        calls: what the function did so far (:func:`observed`), with different branches taken: the record, which takes
            every branch (:func:`pgkit.compiled.every_branch`), has to do the same.
        state: paths of the tensors that these and other functions change (:func:`state_of`); the rest is fixed.
        mode: of :func:`pgkit.compiled.compiled`.
        name: what messages call it.

    Raises:
        RuntimeError: it cannot be recorded.
    """

    def __init__(
        self, function: Function, find: Find, calls: Sequence[Call], state: set[str], mode: Mode, name: str
    ) -> None:
        first = calls[0]
        self._fixed = {path: x for path, x in first.before.items() if path not in state}
        twin = find()
        own: dict[int, list[str]] = {}  # the same tensor in two places is one input
        for path, _, _, x in twin:
            if path in state:
                own.setdefault(id(x), []).append(path)
        self._paths, self._shapes = list(own.values()), {path: _kind(x) for path, _, _, x in twin}
        self._results = len(first.results)

        def pure(_: None, *tensors: Tensor) -> list[Tensor]:
            inputs, state = tensors[: len(first.inputs)], tensors[len(first.inputs) :]
            slots = find()
            _put([_places(slots, paths) for paths in self._paths], [x.clone() for x in state])
            results = function(*[x.clone() for x in inputs])
            found = {path: x for path, _, _, x in find()}
            return [x.contiguous() for x in (*results, *[found[paths[0]] for paths in self._paths])]

        others = [(None, *call.inputs, *self._state(call.before)) for call in calls]
        if any(x.device.type != "cpu" for x in first.inputs):
            raise RuntimeError("it is not on the CPU")
        if wrong := [call.wrong for call in calls if call.wrong]:
            raise RuntimeError(wrong[0])
        for call, arguments in zip(calls, others, strict=True):
            self._check(call, pure, arguments)
        door = compiled(every_branch(pure, *others[0]), {}, lambda *_: others[1:], mode, name, most=_MOST, fixed=True)
        try:
            self._run = door.bind(*others[0])
        except UserError as error:
            raise RuntimeError(str(error.__cause__)) from error
        self.rung, self.seconds = door.rung, door.seconds

    def _state(self, values: dict[str, Any]) -> list[Tensor]:
        return [values[paths[0]].contiguous() for paths in self._paths]

    def _check(self, call: Call, pure: Function, arguments: Sequence[Any]) -> None:
        """The function has to be one of its inputs and the state that was found."""
        torch.set_rng_state(call.random)
        expected = [*call.results, *self._state(call.after)]
        for mine, its in zip(pure(*arguments), expected, strict=True):
            if mine.shape != its.shape or not torch.equal(mine.nan_to_num(), its.nan_to_num()):
                raise RuntimeError("it depends on more than its tensors and those that its objects hold")

    def bind(self, find: Find) -> Function | str:
        """The native function on these objects, or in words why it does not fit them."""
        slots = find()
        if (found := {path: _kind(x) for path, _, _, x in slots}) != self._shapes:
            unlike = min(path for path in found.keys() | self._shapes if found.get(path) != self._shapes.get(path))
            return f"'{unlike.strip('.')}' is another than it was when recorded"
        values = {path: x for path, _, _, x in slots}
        for path, x in self._fixed.items():
            if not (torch.equal(x, values[path]) if isinstance(x, Tensor) else x == values[path]):
                return f"'{path.strip('.')}' is another than it was when recorded"
        places, run, count = [_places(slots, paths) for paths in self._paths], self._run, self._results

        def call(*inputs: Tensor) -> Sequence[Tensor]:
            state = [holder[name] for (holder, name), *_ in places]
            out = run(*inputs, *[x if x.is_contiguous() else x.contiguous() for x in state])
            _put(places, out[count:])
            return out[:count]

        return call


Places = Sequence[Sequence[tuple[Any, Any]]]  # for each tensor of the state, the dicts or lists that hold it


def _places(slots: Sequence[Slot], paths: Sequence[str]) -> list[tuple[Any, Any]]:
    holders = {
        path: (x if isinstance(x, dict | list) else vars(x), name) for path, x, name, _ in slots if path in paths
    }
    return [holders[path] for path in paths]


def _put(places: Places, values: Iterable[Tensor]) -> None:
    for held, x in zip(places, values, strict=True):
        for holder, name in held:
            holder[name] = x


def _kind(x: Any) -> Any:
    return (x.shape, x.dtype) if isinstance(x, Tensor) else type(x)


def state_of(calls: Sequence[Call], num_envs: int) -> set[str]:
    """Paths of the tensors that are one for each environment, or that changed."""
    first = calls[0].before
    values = [values for call in calls for values in (call.before, call.after)]
    return {
        path
        for path, x in first.items()
        if isinstance(x, Tensor)
        and (x.shape[:1] == (num_envs,) or any(_differ(x, other[path]) for other in values if path in other))
    }


def _differ(one: Any, other: Any) -> bool:
    return _kind(one) != _kind(other) or not torch.equal(one, other)


class Native:
    """Functions of one object, each as native code where it was recorded.

    Args:
        recorded: by the function's name.
        find: lists what the object holds.
        kind: what messages call the object.
    """

    def __init__(self, recorded: Mapping[str, Recorded], find: Find, kind: str) -> None:
        self._recorded, self._find, self._kind = dict(recorded), find, kind
        self._bound: dict[str, Function] = {}

    @property
    def names(self) -> list[str]:
        """The functions that are native."""
        return list(self._recorded)

    def __call__(self, function: Function, *inputs: Tensor) -> Sequence[Tensor]:
        """``function(*inputs)``."""
        name = function.__name__
        if name in self._recorded and name not in self._bound:
            found = self._recorded[name].bind(self._find)
            if isinstance(found, str):
                getLogger("pgkit").info("%s runs as it is from now on: %s", self._kind, found)
                self._recorded.clear()
            else:
                self._bound[name] = found
        if name in self._bound:
            return self._bound[name](*inputs)
        self._bound.clear()  # the function may replace the objects that hold the state
        return function(*inputs)


def record(
    functions: Sequence[Function], find: Find, play: Callable[..., None], num_envs: int, mode: Mode, kind: str
) -> dict[str, Recorded]:
    """The functions that can be recorded, by name; a log line for each that cannot.

    Args:
        functions: of a twin, an object of the recording's own: its ``advance`` and its ``renew``.
        find: lists what the twin holds.
        play: calls the functions that it is given, in a way that takes all branches.
        num_envs: number of environments.
        mode: of :func:`pgkit.compiled.compiled`; ``on``: a ``UserError`` for a function that cannot be recorded.
        kind: what messages call the simulator.
    """
    found: dict[str, Recorded] = {}
    calls: dict[str, list[Call]] = {function.__name__: [] for function in functions}
    play(*[observed(function, find, calls[function.__name__]) for function in functions])
    state = state_of([call for each in calls.values() for call in each], num_envs)
    for function in functions:
        name = function.__name__
        with falls_back(f"{_WORDS.get(name, name)} of {kind}", mode):
            found[name] = Recorded(
                function, find, calls[name][:: len(calls[name]) // 5], state, mode, f"{name} of {kind}"
            )
    return found


@contextmanager
def falls_back(name: str, mode: Mode) -> Iterator[None]:
    """What cannot be recorded runs as it is, with a line in the log; in the mode ``on`` that is a ``UserError``."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # scenarios raise anything when they are recorded
        why = str(error).strip().partition("\n")[0] or type(error).__name__
        if mode == "on":
            raise UserError(f"{name} cannot be recorded ({why}): compile='auto' runs it as it is") from error
        getLogger("pgkit").info("%s is not recorded and runs as it is: %s", name, why)
