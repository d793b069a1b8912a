"""The one door to native code: a ladder of ways to run a function, from compiled to as it is."""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from logging import INFO, WARNING, getLogger
from typing import Any, Literal, cast

from tensordict import TensorDictBase
from torch import Tensor

from pgkit.compiled.constants import Constants, tensors_of
from pgkit.compiled.native import compile_record, torch_compiled
from pgkit.compiled.recorded import Bind, Function, Task, recorded
from pgkit.compiled.trial import check_repeats
from pgkit.errors import UserError

Mode = Literal["on", "auto", "record", "off"]
RECORDED, TRACED, REPLAYED, EAGER = "recorded and compiled", "torch.compile", "recorded, not compiled", "eager"
_LADDERS: dict[str, tuple[str, ...]] = {
    "on": (RECORDED, TRACED),
    "auto": (RECORDED, TRACED, REPLAYED, EAGER),
    "record": (REPLAYED, EAGER),
    "off": (EAGER,),
}
_MOST_LAYOUTS = 4  # that are compiled for


def check_compile(compile: str) -> None:
    """A ``UserError`` for anything but ``auto``, ``on`` or ``off``."""
    if compile not in ("auto", "on", "off"):
        raise UserError(f"compile is 'auto', 'on' or 'off', not {compile!r}")


def choose(compile: str, calls: float | None, least_calls: float) -> Mode:
    """The door's mode for the user's choice ``auto``, ``on`` or ``off``.

    Args:
        compile: ``auto`` compiles where there is a C++ compiler and enough calls are expected.
        calls: expected number of calls; None: not known, and taken to be enough.
        least_calls: number of calls that win the compile time back.
    """
    check_compile(compile)
    if compile == "auto" and shutil.which("g++") is None and shutil.which("clang++") is None:
        getLogger("pgkit").warning("no C++ compiler (g++) found: running without torch.compile, about 3 times slower")
        return "off"
    return "off" if compile == "auto" and calls is not None and calls < least_calls else cast(Mode, compile)


def compiled(
    function: Function,
    *,
    watch: Mapping[str, Any],
    holds: Iterable[Tensor] = (),
    others: Callable[..., Iterable[Sequence[Any]]],
    mode: Mode,
    name: str,
    most: int | None = None,
) -> Compiled:
    """``function(data, *inputs) -> [tensor, ...]`` as native code; ``compiled(...).bind(data, *inputs)`` is its call.

    What the function closes over is a constant, as in JAX. Noticed, with a warning and new code at the next ``bind``,
    is a change of the parameters, buffers and attributes of the modules in ``watch``, and of what a callable that one
    of them holds directly closes over. Values written in place (``fill_``, an optimizer's step) need nothing.

    Args:
        function: tensors in, a list or tuple of tensors out. ``data`` is a TensorDict or None. It changes only what is
            held, in place, and entries of ``data``; with ``torch.no_grad`` or without as it says itself.
        watch: modules (or functions) that it uses, by what a message calls them: ``{"the loss": loss}``. Their
            parameters and buffers are held.
        holds: further tensors that it changes or that change in place: optimizer state, priorities, a cache.
        others: ``(data, *inputs) -> [(data, *inputs), ...]``, more inputs of the same layout, on which native code has
            to repeat the function; other rows, or random ones for numbers that may be any.
        mode: ``on``: recorded and compiled, else by ``torch.compile``, else a ``UserError``. ``auto``: besides these
            recorded without a compiler, else as it is. ``record``: recorded without a compiler (the same bits), else as
            it is. ``off``: as it is.
        name: what the log calls it: ``the update``.
        most: operations that are worth compiling, of a function that may be a long loop; it skips ``torch.compile``.
    """
    return Compiled(function, watch, list(holds), others, mode, name, most)


class Compiled:
    """What :func:`compiled` returns.

    Attributes:
        function: the function as it is, for inputs that are not worth compiling.
        seconds: spent recording and compiling so far.
        rung: how it runs: ``recorded and compiled``, ``torch.compile``, ``recorded, not compiled`` or ``eager``.
    """

    def __init__(
        self,
        function: Function,
        watch: Mapping[str, Any],
        holds: Sequence[Tensor],
        others: Callable[..., Iterable[Sequence[Any]]],
        mode: Mode,
        name: str,
        most: int | None,
    ) -> None:
        self.function, self.seconds, self.rung = function, 0.0, EAGER
        self._watch, self._holds, self._others, self._mode, self._name = watch, holds, others, mode, name
        self._most, self._ladder = most, [rung for rung in _LADDERS[mode] if most is None or rung != TRACED]
        self._built: dict[Any, Bind] = {}
        self._constants: Constants | None = None

    def bind(self, data: TensorDictBase | None, *inputs: Tensor) -> Function:
        """``call(*inputs) -> [tensor, ...]`` on this data, for inputs laid out like these.

        Bind once a rollout: here the layout (keys, shapes, dtypes, strides, devices) is checked and changes are
        noticed; a call checks nothing. The first bind of a layout records and compiles, up to 40 seconds; the function
        runs for that, which is undone. The results of a call stay what they are at the next one.
        """
        if self._mode == "off":
            return partial(self.function, data)
        changed = None if self._constants is None else self._constants.changed()
        if changed:
            getLogger("pgkit").warning(
                "%s is compiled again: %s (what changes in place, by fill_, needs no such thing)", self._name, changed
            )
            self._built, self._constants = {}, None
        layout = _layout(data, inputs)
        if layout not in self._built:
            if len(self._built) >= _MOST_LAYOUTS:
                return partial(self.function, data)
            start = time.perf_counter()
            self._built[layout] = self._build(data, inputs)
            self.seconds += time.perf_counter() - start
        return self._built[layout](data)

    def _build(self, data: TensorDictBase | None, inputs: Sequence[Tensor]) -> Bind:
        """The first rung of the ladder that bears."""
        if self._mode != "record":
            getLogger("pgkit").info("compiling %s, once: up to 40 seconds, less when it is in the cache", self._name)
        held = list({id(x): x for x in (*tensors_of(self._watch), *self._holds)}.values())
        others = list(self._others(data, *inputs))
        failed: list[str] = []
        bind: Bind = lambda data: partial(self.function, data)  # noqa: E731
        for rung in self._ladder:
            try:
                bind = self._climb(rung, Task(self.function, held, data, inputs, others))
                break
            except UserError:
                raise
            except Exception as error:  # compilers and a torch whose private parts have moved raise anything
                failed.append(f"{rung}: {_first_line(error)}")
                last = error
        else:
            raise UserError(
                f"{self._name} cannot be compiled ({'; '.join(failed)}): compile='auto' runs it without, compile='off' "
                "does not try"
            ) from last
        self.rung = rung
        self._say(rung, failed)
        return bind

    def _climb(self, rung: str, task: Task) -> Bind:
        if rung == EAGER:
            self._constants = None
            return lambda data: partial(self.function, data)
        self._constants = constants = Constants(self._watch)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the compiler's, on tensordict's and TorchRL's code
            if rung == TRACED:
                traced = torch_compiled(self.function)
                check_repeats(traced, self.function, task.held, [(task.data, *task.inputs), *task.others])
                bind: Bind = lambda data: partial(traced, data)  # noqa: E731
            else:
                bind = recorded(task, self._compile if rung == RECORDED else lambda graph, _: graph.forward)
        if changed := constants.changed():
            raise RuntimeError(
                f"it changes a number of its own as it runs, which is no part of a graph: {changed} (hold a tensor)"
            )
        return bind

    def _compile(self, graph: Any, inputs: Sequence[Tensor]) -> Callable[..., Any]:
        if self._most is not None and len(graph.graph.nodes) > self._most:
            raise RuntimeError(f"it is {len(graph.graph.nodes)} operations, too many to compile soon")
        return compile_record(graph, inputs)

    def _say(self, rung: str, failed: Sequence[str]) -> None:
        slow = self._mode != "record" and rung in (REPLAYED, EAGER)
        words = f"runs {rung}"
        if rung == EAGER:
            words = f"cannot be {'compiled' if slow else 'recorded'} and runs without, several times slower"
        why = f" ({'; '.join(failed)})" if failed else ""
        advice = "; compile='on' stops here, compile='off' is silent" if slow else ""
        getLogger("pgkit").log(WARNING if slow else INFO, "%s %s%s%s", self._name, words, why, advice)


def _layout(data: TensorDictBase | None, inputs: Sequence[Tensor]) -> Any:
    leaves = [] if data is None else [(key, data[key]) for key in data.keys(True, True)]
    return tuple((key, *_laid_out(x)) for key, x in leaves), tuple(_laid_out(x) for x in inputs)


def _laid_out(x: Tensor) -> Any:
    strides = tuple(stride for size, stride in zip(x.shape, x.stride(), strict=True) if size > 1)
    return x.shape, strides, x.dtype, x.device


def _first_line(error: Exception) -> str:
    return f"{error}".strip().partition("\n")[0] or type(error).__name__
