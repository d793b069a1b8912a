"""Convolutions of a recorded graph in bfloat16 where that is asked for, and faster on this CPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from logging import getLogger
from typing import Any, cast

import torch
from torch.fx import GraphModule, Node, Proxy
from torch.fx.proxy import GraphAppendingTracer

from pgkit.compiled.products import chosen, fastest, in_bfloat16, layout, like

_aten = torch.ops.aten


def halve_convolutions(graph: GraphModule) -> None:
    """With ``--matmul bf16``: convolutions of float32 images on a CPU and their gradients, where bfloat16 is faster.

    A bias, and its gradient, stay float32.
    """
    if not in_bfloat16():
        return
    tracer, found, taken = GraphAppendingTracer(graph.graph), 0, 0
    for node in list(graph.graph.nodes):
        halved = {_aten.convolution.default: _forward, _aten.convolution_backward.default: _backward}.get(node.target)
        if halved is None or not _is_of_images(node):
            continue
        found += 1
        if _is_faster(node, halved):
            taken += 1
            with graph.graph.inserting_before(node):
                made = halved(*(Proxy(x, tracer) if isinstance(x, Node) else x for x in node.args))
            _replace(node, made)
    graph.recompile()
    if found:
        getLogger("pgkit").info("convolutions and their gradients: %d of %d in bfloat16", taken, found)


def _is_of_images(node: Node) -> bool:
    """Whether it is a convolution in float32 over two dimensions on a CPU."""
    factors = [x.meta["val"] for x in node.args if isinstance(x, Node)]
    known = all(x.dtype is torch.float32 and x.device.type == "cpu" for x in factors)
    return known and factors[0].ndim == 4 and not node.kwargs


def _is_faster(node: Node, halved: Callable[..., Any]) -> bool:
    """Whether bfloat16 wins for numbers laid out like these."""

    def measure() -> str:
        args = [like(x.meta["val"]) if isinstance(x, Node) else x for x in node.args]
        return fastest({"torch": partial(cast(Any, node.target), *args), "bf16": partial(halved, *args)})

    words = [layout(x.meta["val"]) if isinstance(x, Node) else str(x) for x in node.args]
    return chosen(f"{node.target} {'; '.join(words)}", measure) == "bf16"


def _replace(node: Node, made: Any) -> None:
    """The result in place of the node, or the results in place of those that are picked from it."""
    pairs = [(node, made)] if isinstance(made, Proxy) else [(pick, made[pick.args[1]]) for pick in list(node.users)]
    for old, new in pairs:
        if new is not None:  # a gradient that nobody reads
            old.replace_all_uses_with(new.node)
            new.node.meta["val"] = old.meta["val"]
        if old is not node:
            node.graph.erase_node(old)
    node.graph.erase_node(node)


def _forward(x: Any, weight: Any, bias: Any, *rest: Any) -> Any:
    made = _whole(_aten.convolution.default(_half(x), _half(weight), None, *rest))
    return made if bias is None else _aten.add.Tensor(made, _aten.view.default(bias, [1, -1, 1, 1]))


def _backward(grad: Any, x: Any, weight: Any, sizes: Any, *rest: Any) -> list[Any]:
    *form, wanted = rest
    only = [wanted[0], wanted[1], False]
    made = _aten.convolution_backward.default(_half(grad), _half(x), _half(weight), None, *form, only)
    results = [_whole(made[at]) if wanted[at] else None for at in range(2)]
    return [*results, _aten.sum.dim_IntList(grad, [0, 2, 3]) if wanted[2] else None]


def _half(x: Any) -> Any:
    return _aten._to_copy.default(x, dtype=torch.bfloat16)


def _whole(x: Any) -> Any:
    return _aten._to_copy.default(x, dtype=torch.float32)
