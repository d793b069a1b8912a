"""Steps and blocks recorded as tensor operations and compiled without dynamo, which costs more than a small step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.fx import GraphModule

from pgkit.compiling import compile_record, record

Block = Callable[[TensorDictBase], TensorDictBase]
Step = Callable[[TensorDictBase, Tensor], tuple[Tensor, list[Tensor]]]


def recorded(step: Step, held: Sequence[Tensor], data: TensorDictBase, index: Tensor) -> Step:
    """``step`` as one compiled graph, for data and indices of these shapes.

    The recording runs the step, and so does a check that the compiled graph repeats it on other rows; both are undone.

    Args:
        step: changes tensors of ``held`` in place, and no others.
        held: parameters, buffers, optimizer state and learning rates, each once.
        data: what the step indexes, nested or not.
        index: example indices ``[B]``.

    Raises:
        RuntimeError: the step decides something on a tensor's value, works on a tensor that shares memory with one of
            ``held`` without being it, or does not repeat itself on other rows.
    """
    keys = list(data.keys(True, True))

    def flat(*inputs: Tensor) -> list[Tensor]:
        leaves = dict(zip(keys, inputs[len(held) : -1], strict=True))
        rows = data.copy()  # of nested TensorDicts too, so that ``data`` stays as it is
        for key, leaf in leaves.items():
            rows.set(key, leaf)
        metrics, grads = step(rows, inputs[-1])
        return [metrics, *grads]

    graph = _undone(held, lambda: record(flat, [*held, *(data[key] for key in keys), index]))
    memory = {tensor.untyped_storage().data_ptr() for tensor in held}
    for node in graph.graph.find_nodes(op="get_attr"):
        constant = getattr(graph, str(node.target))
        if isinstance(constant, Tensor) and constant.untyped_storage().data_ptr() in memory:
            raise RuntimeError(f"tracing: '{node.target}' shares memory with a parameter or buffer without being it")
    fixed = [tensor.detach() for tensor in held]
    code = compile_record(graph, [*fixed, *(data[key] for key in keys), index])
    rows, leaves = data, [data[key] for key in keys]

    def run(data: TensorDictBase, index: Tensor) -> tuple[Tensor, list[Tensor]]:
        nonlocal rows, leaves
        if data is not rows:
            rows, leaves = data, [data[key] for key in keys]
        with torch.no_grad():
            metrics, *grads = code(*fixed, *leaves, index)
        return metrics, grads

    # a decision taken on values outside torch (numpy) is not seen while recording: it would show on other rows
    other = (index + 1) % (index.max() + 1)
    expected, got = (_undone(held, lambda f=f: f(data, other)[0]) for f in (step, run))
    if not torch.allclose(got, expected, rtol=1e-3, atol=1e-4, equal_nan=True):
        raise RuntimeError(f"the recorded step does not repeat the step on other rows: {got} is not {expected}")
    return run


def _undone(tensors: Sequence[Tensor], function: Callable[[], Any]) -> Any:
    """The function's result; what it did to these tensors and to the random generator is undone."""
    before = [tensor.detach().clone() for tensor in tensors]
    try:
        with torch.random.fork_rng(devices=[]):
            return function()
    finally:
        with torch.no_grad():
            for tensor, value in zip(tensors, before, strict=True):
                tensor.copy_(value)


def recorded_block(block: TensorDictModuleBase, data: TensorDictBase) -> Block:
    """``block(data)``, which writes its ``out_keys`` from its ``in_keys``, as one compiled graph.

    Data of other shapes or strides than these goes through the block itself.

    Raises:
        RuntimeError: the block decides something on a tensor's value, changes a buffer, or is too long to compile soon.
    """
    buffers = list(block.buffers())

    def flat(*leaves: Tensor) -> list[Tensor]:
        rows = TensorDict({}, batch_size=data.batch_size)
        for key, leaf in zip(block.in_keys, leaves, strict=True):
            rows.set(key, leaf)
        out = block(rows)
        return [out.get(key) for key in block.out_keys]

    def inputs(data: TensorDictBase) -> list[Tensor]:
        return [data.get(key) for key in block.in_keys]

    leaves = inputs(data)

    def recording() -> tuple[GraphModule, bool]:
        versions = [x._version for x in buffers]
        graph = record(flat, leaves)
        return graph, versions != [x._version for x in buffers]

    graph, changed = _undone(buffers, recording)
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
