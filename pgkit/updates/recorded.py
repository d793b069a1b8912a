"""Steps and blocks recorded as tensor operations and compiled without dynamo, which costs more than a small step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from logging import getLogger
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch._ops import OpOverload
from torch.fx import GraphModule, Node

from pgkit.compiling import compile_record, record
from pgkit.updates.decisions import Decisions
from pgkit.updates.restoring import undone

Block = Callable[[TensorDictBase], TensorDictBase]
Result = tuple[Tensor, list[Tensor]]
Step = Callable[[TensorDictBase, Tensor], Result]
_MOST_GRAPHS = 3  # of one step, for different decisions: each takes seconds to compile


def recorded(step: Step, held: Sequence[Tensor], data: TensorDictBase, index: Tensor) -> Step:
    """``step`` as compiled graphs, for data and indices of these shapes.

    A step that decides something on tensors' values (``if kl > bound``) gets a graph for the decisions that it takes
    here; the graph tests them and changes nothing where one comes out otherwise. Up to three sets of decisions are
    recorded, as they occur; others run the step itself.

    The recording runs the step, and so does a check that the compiled graph repeats it on other rows; both are undone.

    Args:
        step: changes tensors of ``held`` in place, and no others.
        held: parameters, buffers, optimizer state and learning rates, each once.
        data: what the step indexes, nested or not.
        index: example indices ``[B]``.

    Raises:
        RuntimeError: the step reads a number that is another on other rows, works on a tensor that shares memory with
            one of ``held`` without being it, or does not repeat itself on other rows.
    """
    first, decisions = _graph(step, held, data, index)
    for shift in range(1, 5):  # a decision taken on values outside torch (numpy) is not seen: it shows on other rows
        other = (index + shift * (len(index) + 1)) % (index.max() + 1)
        # data that is the batch may be used without the index: it gets other rows as well, some of them repeated
        rows = _other_rows(data, other // (1 + shift)) if data.batch_size == index.shape else data
        expected, got = (undone(held, lambda f=f, rows=rows, other=other: f(rows, other)) for f in (step, first))
        if got is None and decisions.numbers:
            raise RuntimeError("the step reads a number off a tensor, and it is another on other rows")
        if got is not None and not torch.allclose(got[0], expected[0], rtol=1e-3, atol=1e-4, equal_nan=True):
            raise RuntimeError(f"recorded, the step differs on other rows: {got[0]} is not {expected[0]}")
    if not decisions:
        return cast(Step, first)
    graphs = [first]

    def run(data: TensorDictBase, index: Tensor) -> Result:
        random = torch.get_rng_state()
        for position, graph in enumerate(graphs):
            result = graph(data, index)
            if result is not None:
                graphs.insert(0, graphs.pop(position))
                return result
            torch.set_rng_state(random)
        if len(graphs) < _MOST_GRAPHS:
            getLogger("pgkit").info("compiling the update for another branch of the loss, once: a few seconds")
            graphs.insert(0, _graph(step, held, data, index)[0])
        return step(data, index)

    return run


def _other_rows(data: TensorDictBase, rows: Tensor) -> TensorDictBase:
    """``data[rows]``, as many rows as there are, in the memory layout of ``data``."""
    return cast(TensorDictBase, data.apply(lambda x: x.clone().copy_(x[rows])))


def _graph(
    step: Step, held: Sequence[Tensor], data: TensorDictBase, index: Tensor
) -> tuple[Callable[[TensorDictBase, Tensor], Result | None], Decisions]:
    """The step as one graph, and the decisions it was recorded with; it gives None where they are others."""
    known = {id(tensor) for tensor in held}
    keys = [key for key in data.keys(True, True) if id(data[key]) not in known]  # priorities are held and in the data
    decisions = Decisions()

    def flat(*inputs: Tensor) -> list[Tensor]:
        leaves = dict(zip(keys, inputs[len(held) : -1], strict=True))
        rows = data.copy()  # of nested TensorDicts too, so that ``data`` stays as it is
        for key, leaf in leaves.items():
            rows.set(key, leaf)
        before = [tensor.detach().clone() for tensor in inputs[: len(held)]]
        with decisions:
            metrics, grads = step(rows, inputs[-1])
        if not decisions:
            return [metrics, *grads]
        as_recorded = decisions.hold()
        with torch.no_grad():
            for tensor, value in zip(inputs[: len(held)], before, strict=True):
                tensor.copy_(torch.where(as_recorded, tensor, value))
        return [as_recorded, metrics, *grads]

    graph = undone(held, lambda: record(flat, [*held, *(data[key] for key in keys), index]))
    memory = {tensor.untyped_storage().data_ptr() for tensor in held}
    for node in graph.graph.find_nodes(op="get_attr"):
        constant = getattr(graph, str(node.target))
        if isinstance(constant, Tensor) and constant.untyped_storage().data_ptr() in memory:
            raise RuntimeError(f"tracing: '{node.target}' shares memory with a parameter or buffer without being it")
        if _is_written(node):
            raise RuntimeError(f"tracing: the step writes to '{node.target}', which is none of what it holds")
    fixed = [tensor.detach() for tensor in held]
    code = compile_record(graph, [*fixed, *(data[key] for key in keys), index])
    rows, leaves = data, [data[key] for key in keys]

    def run(data: TensorDictBase, index: Tensor) -> Result | None:
        nonlocal rows, leaves
        if data is not rows:
            rows, leaves = data, [data[key] for key in keys]
        with torch.no_grad():
            out = code(*fixed, *leaves, index)
        if decisions and not out.pop(0):
            return None
        metrics, *grads = out
        return metrics, grads

    return run, decisions


def _is_written(node: Node) -> bool:
    """Whether an operation of the graph changes this tensor in place, or a view of it."""
    for user in node.users:
        operation = user.target
        if isinstance(operation, OpOverload) and user.args[:1] == (node,):
            inplace = torch.Tag.inplace in operation.tags
            if inplace or (operation.is_view and _is_written(user)):
                return True
    return False


def recorded_block(block: TensorDictModuleBase, data: TensorDictBase) -> Block:
    """``block(data)``, which writes its ``out_keys`` from its ``in_keys``, as one compiled graph.

    Data of other shapes or strides than these goes through the block itself.

    Raises:
        RuntimeError: the block decides something on a tensor's value, changes a buffer, or is too long to compile soon.
    """
    buffers = list(block.buffers())
    present = [key for key in block.in_keys if key in data.keys(True)]  # of entries in two places, or a mask

    def flat(*leaves: Tensor) -> list[Tensor]:
        rows = TensorDict({}, batch_size=data.batch_size)
        for key, leaf in zip(present, leaves, strict=True):
            rows.set(key, leaf)
        out = block(rows)
        return [out.get(key) for key in block.out_keys]

    def inputs(data: TensorDictBase) -> list[Tensor]:
        return [data.get(key) for key in present]

    leaves = inputs(data)

    def recording() -> tuple[GraphModule, bool]:
        versions = [x._version for x in buffers]
        graph = record(flat, leaves)
        return graph, versions != [x._version for x in buffers]

    graph, changed = undone(buffers, recording)
    if changed or len(graph.graph.nodes) > 300:
        what = "changes a buffer" if changed else f"is {len(graph.graph.nodes)} operations, too many to compile soon"
        raise RuntimeError(f"tracing: {type(block).__name__} {what}")
    code = compile_record(graph, leaves)
    layout = [(x.shape, x.stride()) for x in leaves]

    def run(data: TensorDictBase) -> TensorDictBase:
        leaves = inputs(data)
        if [(x.shape, x.stride()) for x in leaves] != layout:
            return block(data)
        with torch.no_grad():
            for key, x in zip(block.out_keys, code(*leaves), strict=True):
                data.set(key, x)
        return data

    return run
