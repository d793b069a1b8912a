"""The one door to native code: a ladder of ways to run a function, from compiled to as it is."""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from logging import DEBUG, INFO, WARNING, getLogger
from typing import Any, Literal, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pgkit.compiled.constants import Constants, tensors_of
from pgkit.compiled.native import call_functions, check_shapes, compile_record, torch_compiled
from pgkit.compiled.recorded import Bind, Function, Recorder, recorded
from pgkit.compiled.trial import check_repeats
from pgkit.errors import UserError

Mode = Literal["on", "auto", "record", "off"]
RECORDED, TRACED, REPLAYED, EAGER = "recorded and compiled", "torch.compile", "recorded, not compiled", "eager"
_LADDERS: dict[str, tuple[str, ...]] = {
    "on": (RECORDED, TRACED),
    "auto": (RECORDED, TRACED, REPLAYED, EAGER),
    "record": (REPLAYED, EAGER),
}
_MOST_LAYOUTS = 4  # that are compiled for


def check_compile(compile: str) -> None:
    """A ``UserError`` for anything but ``auto``, ``on`` or ``off``."""
    if compile not in ("auto", "on", "off"):
        raise UserError(f"compile is 'auto', 'on' or 'off', not {compile!r}")


def has_compiler() -> bool:
    """Whether this machine has a C++ compiler."""
    return any(map(shutil.which, ("g++", "clang++")))


def choose(compile: str, calls: float | None, least_calls: float) -> Mode:
    """The door's mode for the user's choice ``auto``, ``on`` or ``off``.

    Args:
        compile: ``auto`` compiles where there is a C++ compiler and enough calls are expected.
        calls: expected number of calls; None: not known, and taken to be enough.
        least_calls: number of calls that win the compile time back.
    """
    check_compile(compile)
    if compile == "auto" and not has_compiler():
        getLogger("pgkit").warning("no C++ compiler (g++) found: running without torch.compile, about 3 times slower")
        return "off"
    return "off" if compile == "auto" and calls is not None and calls < least_calls else cast(Mode, compile)


@dataclass
class Compiled:
    """``compiled(function, ...).bind(data, *inputs)`` is ``function(data, *inputs) -> [tensor, ...]`` as native code.

    What the function closes over is a constant, as in JAX. Noticed, with a warning and new code at the next ``bind``,
    is a change of the parameters, buffers and attributes of the modules in ``watch``, and of what a callable that one
    of them holds directly closes over. Values written in place (``fill_``, an optimizer's step) need nothing.

    Args:
        function: tensors in, a list or tuple of tensors out. ``data`` is a TensorDict or None. It changes only what is
            held, in place, and entries of ``data``; with ``torch.no_grad`` or without as it says itself.
        watch: modules (or functions) that it uses, by what a message calls them: ``{"the loss": loss}``. Their
            parameters and buffers are held.
        others: ``(data, *inputs) -> [(data, *inputs), ...]``, more inputs of the same layout, on which native code has
            to repeat the function: other rows, or random ones for numbers that may be any.
        mode: ``on``: recorded and compiled, else by ``torch.compile``, else a ``UserError``. ``auto``: besides these
            recorded without a compiler, else as it is. ``record``: recorded without a compiler (the same bits), else as
            it is. ``off``: as it is.
        name: what the log calls it: ``the update``.
        holds: further tensors that it changes or that change in place: optimizer state, priorities, a cache.
        but: names of attributes whose changes say nothing.
        agree: whether all of several learners took a rung, from whether this one did.
        most: operations that are worth compiling, of a function that may be a long loop; it skips ``torch.compile``.
        fixed: refuses a record in which values decide how many elements something has, and to run the function as it
            is: a ``UserError`` then, in every mode but ``off``.

    Attributes:
        seconds: spent recording and compiling so far.
        rung: how it runs: ``recorded and compiled``, ``torch.compile``, ``recorded, not compiled`` or ``eager``.
    """

    function: Function
    watch: Mapping[str, Any]
    others: Callable[..., Iterable[Sequence[Any]]]
    mode: Mode
    name: str
    holds: Sequence[Tensor] = ()
    agree: Callable[[bool], bool] = bool
    most: int | None = None
    but: Collection[str] = ()
    fixed: bool = False
    seconds: float = field(default=0.0, init=False)
    rung: str = field(default=EAGER, init=False)
    _built: dict[Any, Bind] = field(default_factory=dict, init=False)
    _constants: Constants | None = field(default=None, init=False)

    def bind(self, data: TensorDictBase | None, *inputs: Tensor) -> Function:
        """``call(*inputs) -> [tensor, ...]`` on this data, for inputs laid out like these.

        Bind once a rollout: here the layout (keys, shapes, dtypes, strides, devices) is checked and changes are
        noticed; a call checks nothing. The first bind of a layout records and compiles, up to 40 seconds; the function
        runs for that, which is undone. The results of a call stay what they are at the next one.
        """
        if self.mode == "off":
            return partial(self.function, data)
        if self._constants and (changed := self._constants.changed()):
            advice = "what changes in place, by fill_, needs no such thing"
            getLogger("pgkit").warning("%s is compiled again: %s (%s)", self.name, changed, advice)
            self._built.clear()
        layout = _layout(data, inputs)
        if layout not in self._built:
            if len(self._built) == _MOST_LAYOUTS:
                getLogger("pgkit").warning("%s runs without: its data has more than 4 layouts", self.name)
            if len(self._built) >= _MOST_LAYOUTS:
                self._built[layout] = lambda data: partial(self.function, data)
                return partial(self.function, data)
            start = time.perf_counter()
            self._built[layout] = self._build(data, inputs)
            self.seconds += time.perf_counter() - start
        return self._built[layout](data)

    def _build(self, data: TensorDictBase | None, inputs: Sequence[Tensor]) -> Bind:
        """The first rung of the ladder that bears."""
        if self.mode != "record":
            getLogger("pgkit").info("compiling %s, once: up to 40 seconds, less when it is in the cache", self.name)
        failed: list[str] = []
        last: Exception | None = None
        for rung in _LADDERS[self.mode]:
            if (rung == TRACED and self.most is not None) or (rung == EAGER and self.fixed):
                continue
            self.rung = rung
            bind = None
            try:
                bind = self._climb(data, inputs)
            except UserError:
                raise
            except Exception as error:  # compilers, and a torch whose private parts have moved, raise anything
                failed.append(f"{rung}: {str(error).strip().partition(chr(10))[0] or type(error).__name__}")
                last = error
            if self.agree(bind is not None) and bind is not None:
                self._say(failed)
                return bind
            if bind is not None:
                failed.append(f"{rung}: another learner cannot")
        raise UserError(
            f"{self.name} cannot be compiled ({'; '.join(failed)}): compile='auto' runs it without, compile='off' does "
            "not try"
        ) from last

    def _climb(self, data: TensorDictBase | None, inputs: Sequence[Tensor]) -> Bind:
        """The function as the present rung runs it, which must repeat it on the other inputs."""
        if self.rung == EAGER:
            return lambda data: partial(self.function, data)
        held = list({id(x): x for x in (*tensors_of(self.watch), *self.holds)}.values())
        others = list(self.others(data, *inputs))
        constants = Constants(self.watch, self.but)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the compiler's, on tensordict's and TorchRL's code
            if self.rung == TRACED:
                traced = torch_compiled(self.function)
                check_repeats(traced, self.function, held, [(data, *inputs), *others])
                bind: Bind = lambda data: partial(traced, data)  # noqa: E731
            else:
                known = {id(tensor) for tensor in held}
                keys = [] if data is None else [key for key in data.keys(True, True) if id(data[key]) not in known]
                bind = recorded(Recorder(self.function, held, keys, self._compile), data, inputs, others)
        if changed := constants.changed():
            raise RuntimeError(
                f"it changes a number of its own as it runs, which is no part of a graph: {changed} (hold a tensor)"
            )
        self._constants = constants
        return bind

    def _compile(self, graph: Any, inputs: Sequence[Tensor]) -> Callable[..., Any]:
        if self.fixed:
            check_shapes(graph)
        if self.rung == REPLAYED:
            quick = call_functions(graph)
            return torch.no_grad()(lambda inputs: quick.forward(*inputs))
        if self.most is not None and len(graph.graph.nodes) > self.most:
            raise RuntimeError(f"it is {len(graph.graph.nodes)} operations, too many to compile soon")
        return compile_record(graph, inputs)

    def _say(self, failed: Sequence[str]) -> None:
        slow = self.mode == "auto" and self.rung in (REPLAYED, EAGER)
        words = f"runs {self.rung}"
        if self.rung == EAGER:
            words = f"cannot be {'compiled' if slow else 'recorded'} and runs without, several times slower"
        why = f" ({'; '.join(failed)})" if failed else ""
        advice = "; compile='on' stops here, compile='off' is silent" if slow else ""
        as_asked = self.mode == "record" and self.rung == REPLAYED
        getLogger("pgkit").log(
            WARNING if slow else DEBUG if as_asked else INFO, "%s %s%s%s", self.name, words, why, advice
        )


compiled = Compiled  # reads as what it does: ``compiled(function, ...)``


def _layout(data: TensorDictBase | None, inputs: Sequence[Tensor]) -> Any:
    leaves = [] if data is None else [(key, data[key]) for key in data.keys(True, True)]
    return tuple((key, *_laid_out(x)) for key, x in leaves), tuple(map(_laid_out, inputs))


def _laid_out(x: Tensor) -> Any:
    strides = tuple(stride for size, stride in zip(x.shape, x.stride(), strict=True) if size > 1)
    return x.shape, strides, x.dtype, x.device
