"""A function recorded as tensor operations, for one layout of its inputs and for the decisions it takes on values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from logging import getLogger
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch._ops import OpOverload
from torch.fx import GraphModule, Node

from pgkit.compiled.captured import captured
from pgkit.compiled.decisions import Decisions
from pgkit.compiled.native import record
from pgkit.compiled.trial import check_repeats, undone

Function = Callable[..., Sequence[Tensor]]
Bind = Callable[[TensorDictBase | None], Function]
_MOST_GRAPHS = 3  # of one function, for different decisions: each takes seconds to compile


@dataclass(frozen=True)
class Task:
    """What is to become native code.

    Args:
        function: ``(data, *inputs) -> tensors``; changes tensors of ``held`` in place, and entries of ``data``.
        held: parameters, buffers, optimizer state and the like, each once.
        data: an example, or None for a function without.
        inputs: further examples.
        others: more of ``(data, *inputs)``, on which native code must repeat the function.
    """

    function: Function
    held: Sequence[Tensor]
    data: TensorDictBase | None
    inputs: Sequence[Tensor]
    others: Sequence[Sequence[Any]]

    @property
    def leaves(self) -> Leaves:
        """What reads the entries of data like this; not those that are held (a replay's priorities are both)."""
        known, data = {id(tensor) for tensor in self.held}, self.data
        return Leaves([] if data is None else [key for key in data.keys(True, True) if id(data[key]) not in known])


@dataclass(frozen=True)
class Leaves:
    """Tensors of a TensorDict in a fixed order."""

    keys: Sequence[Any]

    def __call__(self, data: TensorDictBase | None) -> list[Tensor]:
        return [] if data is None else [data[key] for key in self.keys]


def recorded(task: Task, compile: Callable[..., Any]) -> Bind:
    """``bind(data) -> call``, for data and inputs laid out as the task's.

    A function that decides something on tensors' values (``if kl > bound``) gets a graph for the decisions that it
    takes here; the graph tests them and changes nothing where one comes out otherwise. Up to three sets of decisions
    are recorded, as they occur; others run the function itself. The recording runs the function, which is undone.

    Args:
        task: what to record.
        compile: ``(graph, inputs) -> code``.

    Raises:
        RuntimeError: the function reads a number that is another for other inputs, works on a tensor that shares memory
            with one of ``held`` without being it, or the record does not repeat it.
    """
    graph, decisions = _graph(task, compile)
    leaves_of = task.leaves

    def first(data: TensorDictBase | None, *inputs: Tensor) -> Sequence[Tensor] | None:
        out = graph(*leaves_of(data), *inputs)
        if out is None and decisions.numbers:
            raise RuntimeError("it reads a number off a tensor, and it is another for other inputs")
        return out

    check_repeats(first, task.function, task.held, task.others)
    if decisions:
        return _by_decisions(task, compile, graph)
    if all(x.device.type == "cuda" for x in (*task.held, *leaves_of(task.data), *task.inputs)):
        return captured(graph, leaves_of, task.held, task.inputs)

    def bind(data: TensorDictBase | None) -> Function:
        leaves = leaves_of(data)
        return lambda *inputs: graph(*leaves, *inputs)

    return bind


def _by_decisions(task: Task, compile: Callable[..., Any], first: Callable[..., Any]) -> Bind:
    """Calls the graph whose decisions come out as recorded, and makes new ones as they occur."""
    graphs, leaves_of = [first], task.leaves

    def bind(data: TensorDictBase | None) -> Function:
        leaves = leaves_of(data)

        def call(*inputs: Tensor) -> Sequence[Tensor]:
            random = torch.get_rng_state()
            for position, graph in enumerate(graphs):
                result = graph(*leaves, *inputs)
                if result is not None:
                    graphs.insert(0, graphs.pop(position))
                    return result
                torch.set_rng_state(random)
            if len(graphs) < _MOST_GRAPHS:
                getLogger("pgkit").info("compiling for another branch of the loss, once: a few seconds")
                graphs.insert(0, _graph(replace(task, data=data, inputs=inputs), compile)[0])
            return task.function(data, *inputs)

        return call

    return bind


def _graph(task: Task, compile: Callable[..., Any]) -> tuple[Callable[..., list[Tensor] | None], Decisions]:
    """The function of ``(*leaves, *inputs)`` as one graph, and its decisions: it gives None where they are others."""
    held, decisions = task.held, Decisions()
    keys, leaves = task.leaves.keys, task.leaves(task.data)

    def flat(*tensors: Tensor) -> list[Tensor]:
        given, rest = tensors[: len(held)], tensors[len(held) :]
        rows = None if task.data is None else task.data.copy()  # of nested TensorDicts too: ``data`` stays as it is
        for key, leaf in zip(keys, rest, strict=False):
            rows.set(key, leaf)
        before = [tensor.detach().clone() for tensor in given]
        with decisions:
            results = task.function(rows, *rest[len(keys) :])
        if not decisions:
            return list(results)
        as_recorded = decisions.hold()
        with torch.no_grad():
            for tensor, value in zip(given, before, strict=True):
                tensor.copy_(torch.where(as_recorded, tensor, value))
        return [as_recorded, *results]

    graph = undone(held, lambda: record(flat, [*held, *leaves, *task.inputs]))
    _check_constants(graph, held)
    fixed = [tensor.detach() for tensor in held]
    code = compile(graph, [*fixed, *leaves, *task.inputs])

    def run(*tensors: Tensor) -> list[Tensor] | None:
        with torch.no_grad():
            results = code(*fixed, *tensors)
        return results if not decisions else results[1:] if results[0] else None

    return run, decisions


def _check_constants(graph: GraphModule, held: Sequence[Tensor]) -> None:
    """A RuntimeError for a tensor that a graph uses without being given it, and that is a held one or written to."""
    memory = {tensor.untyped_storage().data_ptr() for tensor in held}
    for node in graph.graph.find_nodes(op="get_attr"):
        constant = getattr(graph, str(node.target))
        if isinstance(constant, Tensor) and constant.untyped_storage().data_ptr() in memory:
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
