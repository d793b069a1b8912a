"""A function recorded as tensor operations, for one layout of its inputs and for the decisions it takes on values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from logging import getLogger
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch._ops import OpOverload
from torch.fx import GraphModule, Node
from torch.overrides import TorchFunctionMode

from pgkit.compiled.captured import captured
from pgkit.compiled.decisions import Decisions
from pgkit.compiled.native import constants_of, record
from pgkit.compiled.trial import check_repeats, undone

Function = Callable[..., Sequence[Tensor]]
Bind = Callable[[TensorDictBase | None], Function]
_MOST_GRAPHS = 3  # of one function, for different decisions: each takes seconds to compile


@dataclass(frozen=True)
class Recorder:
    """Makes graphs of a function.

    Args:
        function: ``(data, *inputs) -> tensors``; changes tensors of ``held`` in place, and entries of ``data``.
        held: parameters, buffers, optimizer state and the like, each once.
        keys: the entries of the data, but for those that are held (a replay's priorities are both).
        compile: ``(graph, inputs) -> code``, a function of a list of tensors.
    """

    function: Function
    held: Sequence[Tensor]
    keys: Sequence[Any]
    compile: Callable[..., Any]

    def leaves(self, data: TensorDictBase | None) -> list[Tensor]:
        """The tensors of data."""
        return [] if data is None else [data[key].detach() for key in self.keys]

    def graph(
        self, data: TensorDictBase | None, inputs: Sequence[Tensor]
    ) -> tuple[Callable[..., list[Tensor] | None], Decisions]:
        """The function of ``(*leaves, *inputs)`` in native code, and its decisions: it gives None where they differ."""
        held, leaves, decisions = self.held, self.leaves(data), Decisions()

        def flat(*tensors: Tensor) -> list[Tensor]:
            given, rest = tensors[: len(held)], tensors[len(held) :]
            rows: Any = None if data is None else data.copy()  # of nested TensorDicts too: ``data`` stays as it is
            for key, leaf in zip(self.keys, rest, strict=False):
                rows.set(key, leaf)
            before = [tensor.detach().clone() for tensor in given]
            with decisions:
                results = self.function(rows, *rest[len(leaves) :])
            if not decisions:
                return list(results)
            as_recorded = decisions.hold()
            with torch.no_grad():
                for tensor, value in zip(given, before, strict=True):
                    tensor.copy_(torch.where(as_recorded, tensor, value))
            return [as_recorded, *results]

        with _StaysInTorch():
            graph = undone(held, lambda: record(flat, [*held, *leaves, *inputs]))
        _check_constants(graph, held)
        fixed = [tensor.detach() for tensor in held]
        code = self.compile(graph, [*fixed, *leaves, *inputs])

        def run(*tensors: Tensor) -> list[Tensor] | None:
            results = code([*fixed, *tensors])
            return results if not decisions else results[1:] if results[0] else None

        return run, decisions


class _StaysInTorch(TorchFunctionMode):
    """Refuses a tensor that becomes a NumPy array: what is computed from that would be a constant of the record."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in (Tensor.numpy, Tensor.__array__):
            raise RuntimeError("it computes with NumPy, which no graph holds")
        return func(*args, **(kwargs or {}))


def recorded(
    recorder: Recorder, data: TensorDictBase | None, inputs: Sequence[Tensor], others: Sequence[Sequence[Any]]
) -> Bind:
    """``bind(data) -> call``, for data and inputs laid out like these.

    A function that decides something on tensors' values (``if kl > bound``) gets a graph for the decisions that it
    takes here; the graph tests them and changes nothing where one comes out otherwise. Up to three sets of decisions
    are recorded, as they occur; others run the function itself. The recording runs the function, which is undone.

    Raises:
        RuntimeError: the function reads a number that is another for other inputs, works on a tensor that shares memory
            with one of the held without being it, or the record does not repeat it on ``others``.
    """
    graph, decisions = recorder.graph(data, inputs)

    def first(data: TensorDictBase | None, *inputs: Tensor) -> Sequence[Tensor] | None:
        out = graph(*recorder.leaves(data), *inputs)
        if out is None and decisions.numbers:
            raise RuntimeError("it reads a number off a tensor, and it is another for other inputs")
        return out

    check_repeats(first, recorder.function, recorder.held, others)
    tensors = [*recorder.held, *recorder.leaves(data), *inputs]
    elsewhere = [tuple(x.shape) for x in tensors if not x.is_cuda]
    if tensors and not elsewhere and not decisions:
        launch = captured(graph, recorder.leaves, recorder.held, inputs)
        launch(data)  # now: where it cannot be captured, the ladder has another rung
        return launch
    if len(elsewhere) < len(tensors):
        why = "it decides on values" if decisions else f"a tensor of shape {elsewhere[0]} is not on the device"
        getLogger("pgkit").info("not one CUDA graph: %s", why)
    graphs = [graph]

    def bind(data: TensorDictBase | None) -> Function:
        if not decisions:
            return cast(Function, partial(graph, *recorder.leaves(data)))
        return partial(_by_decisions, recorder, graphs, data)

    return bind


def _by_decisions(
    recorder: Recorder, graphs: list[Callable[..., Any]], data: TensorDictBase | None, *inputs: Tensor
) -> Sequence[Tensor]:
    """The result of the graph whose decisions come out as recorded; a new one where none does."""
    random = torch.get_rng_state()
    for position, graph in enumerate(graphs):
        result = graph(*recorder.leaves(data), *inputs)
        if result is not None:
            graphs.insert(0, graphs.pop(position))
            return result
        torch.set_rng_state(random)
    if len(graphs) < _MOST_GRAPHS:
        getLogger("pgkit").info("compiling for another branch of the loss, once: a few seconds")
        graphs.insert(0, recorder.graph(data, inputs)[0])
    return recorder.function(data, *inputs)


def _check_constants(graph: GraphModule, held: Sequence[Tensor]) -> None:
    """A RuntimeError for a tensor that a graph uses without being given it, and that is a held one or written to."""
    memory = {tensor.untyped_storage().data_ptr() for tensor in held}
    for node, constant in constants_of(graph):
        if constant.untyped_storage().data_ptr() in memory:
            raise RuntimeError(f"'{node.target}' shares memory with a parameter or buffer without being it")
        if _is_written(node):
            raise RuntimeError(f"it writes to '{node.target}', which is none of what it holds")


def _is_written(node: Node) -> bool:
    """Whether an operation of the graph changes this tensor in place, or a view of it."""
    for user in node.users:
        operation = user.target
        if isinstance(operation, OpOverload) and user.args[:1] == (node,):
            inplace = torch.Tag.inplace in operation.tags
            if inplace or (operation.is_view and _is_written(user)):
                return True
    return False
