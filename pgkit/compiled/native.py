"""Native code from torch: whatever of its interface is not stable, in one place.

A torch whose private parts have moved raises here, and the door takes the next rung of its ladder.
"""

from __future__ import annotations

import sys
import types
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from itertools import zip_longest
from typing import Any, cast

import torch
from torch import Tensor
from torch._guards import TracingContext, tracing
from torch._ops import OpOverload
from torch._subclasses import FakeTensorMode
from torch.compiler import is_dynamo_compiling
from torch.fx import GraphModule, Node, Proxy
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import ShapeEnv
from torch.fx.proxy import GraphAppendingTracer
from torch.fx.subgraph_rewriter import replace_pattern
from torch.utils._python_dispatch import TorchDispatchMode

from pgkit.compiled.convolutions import halve_convolutions
from pgkit.compiled.products import as_they_are, cpu, fastest_products

# the same random numbers as eager code
_OPTIONS: dict[str, Any] = {
    "fallback_random": True,
    "reorder_for_locality": False,
    "size_asserts": False,
    "alignment_asserts": False,
}
# sums over a few action dimensions as loops, which are vectorized: written out, every row takes scalar code;
# C++ around the kernels: Python there costs a small step a quarter of its time
_CPU_OPTIONS: dict[str, Any] = {"unroll_reductions_threshold": 1, "cpp_wrapper": True}


def record(function: Callable[..., Any], inputs: Sequence[Tensor]) -> GraphModule:
    """The tensor operations of ``function(*inputs)``, gradients and in-place changes included, as a graph.

    The function runs once, for real, and believes that it is being compiled; a decision that it takes on a tensor's
    value raises ``RuntimeError``. Tensors that it uses without being given them are referred to.
    """
    with torch.compiler._compile_session_context(), _torchrl_told_so():
        graph = make_fx(function)(*inputs)
        graph.graph.eliminate_dead_code()  # an unused log-probability; what writes in place or draws at random stays
    _mask_in_place(graph)
    return graph


class Instead(TorchDispatchMode):
    """Within it, ``instead(operation, *args, **kwargs)`` runs in the place of every tensor operation."""

    def __init__(self, instead: Callable[..., Any]) -> None:
        super().__init__()
        self._instead = instead

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self._instead(func, *args, **(kwargs or {}))


def copy_all(to: Sequence[Tensor], given: Sequence[Tensor]) -> None:
    """Copies each of the given tensors to its place, in one call."""
    torch._foreach_copy_(to, given)  # pyright: ignore[reportArgumentType]


def _mask_in_place(graph: GraphModule) -> None:
    """Rewrites ``x[mask] -= 1`` and ``x[mask] = y[mask]``, which pick as many elements as the mask says, for all."""
    aten = torch.ops.aten
    for put in graph.graph.find_nodes(op="call_function", target=aten.index_put_.default):
        x, masks, value = put.args[:3]
        pick: Any = value
        views: list[Any] = []
        while pick.target is not aten.index.Tensor and _is_elementwise(pick):
            views += [pick] if pick.target is aten.view.default else []  # of one picked element, without its dimension
            (pick,) = _with_dimensions(pick)
        same = pick.target is aten.index.Tensor and pick.args[1] == masks and len(pick.users) == 1
        if not (same and _is_mask(masks, x) and cast(Node, pick.args[0]).meta["val"].shape == x.meta["val"].shape):
            continue
        with graph.graph.inserting_before(pick):
            whole = graph.graph.call_function(aten.clone.default, (pick.args[0],))
        whole.meta["val"] = x.meta["val"]
        pick.replace_all_uses_with(whole)
        for view in views:
            view.replace_all_uses_with(view.args[0])
            graph.graph.erase_node(view)
        with graph.graph.inserting_before(put):
            mask: Any = masks[0]
            rest = x.meta["val"].ndim - mask.meta["val"].ndim
            for _ in range(rest):
                mask = graph.graph.call_function(aten.unsqueeze.default, (mask, -1))
            masked = graph.graph.call_function(aten.where.self, (mask, put.args[2], x))
            written = graph.graph.call_function(aten.copy_.default, (x, masked))
        written.meta["val"] = x.meta["val"]
        put.replace_all_uses_with(written)
        graph.graph.erase_node(put)
        graph.graph.erase_node(pick)
    graph.recompile()


# operations that torch has a function of the same arguments for
_FUNCTIONS = (torch.abs, torch.add, torch.addmm, torch.bmm, torch.cat, torch.clamp, torch.clamp_max, torch.clamp_min,
    torch.cos, torch.div, torch.exp, torch.log, torch.maximum, torch.minimum, torch.mm, torch.mul, torch.neg, torch.pow,
    torch.reciprocal, torch.relu, torch.rsqrt, torch.rsub, torch.sigmoid, torch.sin, torch.sqrt, torch.squeeze,
    torch.stack, torch.sub, torch.t, torch.tanh, torch.unsqueeze, torch.where)  # fmt: skip


def call_functions(graph: GraphModule) -> GraphModule:
    """Torch's functions in the place of a record's operations, where there are such: each call costs a third."""
    functions = {f"aten::{function.__name__}": function for function in _FUNCTIONS}
    for node in graph.graph.nodes:
        if isinstance(node.target, OpOverload):
            node.target = functions.get(node.target.name().partition(".")[0], node.target)
    graph.recompile()
    return graph


def check_shapes(graph: GraphModule) -> None:
    """A ``RuntimeError`` for an operation whose result has as many elements as the values of a mask say."""
    for node in graph.graph.find_nodes(op="call_function", target=torch.ops.aten.index.Tensor):
        if any(index is not None and index.meta["val"].dtype is torch.bool for index in node.args[1]):
            raise RuntimeError("values decide how many elements it picks (x[mask]): use torch.where")
    for node in graph.graph.nodes:
        counts = node.target is not torch.ops.aten.index.Tensor and node.op == "call_function"
        if counts and torch.Tag.dynamic_output_shape in _tags(node):
            raise RuntimeError(f"values decide how many elements {node.target} gives: use torch.where")


def _is_mask(index: Sequence[Node | None], x: Node) -> bool:
    """Whether an index is one boolean tensor, of the shape of ``x`` or of its first dimensions."""
    mask = index[0].meta["val"] if len(index) == 1 and index[0] is not None else None
    return mask is not None and mask.dtype is torch.bool and mask.shape == x.meta["val"].shape[: mask.ndim]


def _is_elementwise(node: Node) -> bool:
    """Whether this is an elementwise operation on one tensor and numbers, or a view, and its result is used once."""
    one = len(_with_dimensions(node)) == len(node.users) == 1
    view = node.target is torch.ops.aten.view.default
    return one and (view or torch.Tag.pointwise in _tags(node))


def _tags(node: Node) -> Sequence[torch.Tag]:
    """What torch says of an operation; nothing of what is no operation of torch's."""
    return getattr(node.target, "tags", ())


def _with_dimensions(node: Node) -> list[Node]:
    """The inputs of an operation that are more than a number."""
    return [tensor for tensor in node.all_input_nodes if tensor.meta["val"].ndim]


@contextmanager
def _torchrl_told_so() -> Iterator[None]:
    """TorchRL's losses ask ``is_dynamo_compiling()``, a constant that dynamo alone replaces: here it says yes."""
    asking = [
        module
        for name, module in list(sys.modules.items())
        if name.startswith("torchrl.") and vars(module).get("is_dynamo_compiling") is is_dynamo_compiling
    ]
    for module in asking:
        vars(module)["is_dynamo_compiling"] = lambda: True
    try:
        yield
    finally:
        for module in asking:
            vars(module)["is_dynamo_compiling"] = is_dynamo_compiling


def compile_record(graph: GraphModule, inputs: Sequence[Tensor]) -> Callable[[list[Tensor]], Any]:
    """Inductor's code for a recorded graph: a function of a list, which it empties.

    It checks nothing: call it with tensors like ``inputs`` and no others.
    """
    from torch._inductor.compile_fx import compile_fx, compile_fx_inner  # 4 seconds, for those who compile

    (results,) = graph.graph.output_node().args
    fastest_products(graph)
    halve_convolutions(graph)
    constants = _as_inputs(graph)
    tensors, options = [*inputs, *constants], _OPTIONS
    if all(x.device.type == "cpu" for x in tensors):
        options = _OPTIONS | _CPU_OPTIONS
        _batch_products(graph)
        _quick_tanh(graph)
        for node in graph.graph.nodes:
            node.meta.clear()  # the C++ wrapper refuses values of the recording's own mode
    kernels: list[Any] = []

    def compile_kernels(graph: GraphModule, taken: Sequence[Any], **kwargs: Any) -> Any:
        kernels.append((len(taken), compile_fx_inner(graph, taken, **kwargs)))
        return kernels[-1][1]

    # with a record of shapes, inductor keeps its code for later processes; its key lacks the CPU's instructions
    fixed = ShapeEnv(allow_scalar_outputs=False, allow_dynamic_output_shape_ops=False)
    shapes = TracingContext(FakeTensorMode(allow_non_fake_inputs=True, shape_env=fixed))
    kept = torch.compiler.config.patch(cache_key_tag=f"pgkit, {cpu()}")
    with torch.no_grad(), as_they_are(), tracing(shapes), kept:
        code = compile_fx(graph, tensors, inner_compile=compile_kernels, config_patches=options)
    # around the kernels, aliases are taken apart: nothing to do where they take and give what the graph does
    if len(kernels) == 1:
        taken, compiled = kernels[0]
        if taken == len(tensors) and len(compiled.output_strides or ()) == len(cast(Any, results)):
            run = compiled.current_callable
            return (lambda inputs: run(inputs + constants)) if constants else run
    code = getattr(code, "__wrapped__", code)  # a wrapper that only keeps dynamo out
    return lambda inputs: code(*inputs, *constants)


def _as_inputs(graph: GraphModule) -> list[Tensor]:
    """Makes the tensors that a graph refers to its last inputs, and returns them."""
    constants = []
    after = graph.graph.find_nodes(op="placeholder")[-1]
    for node, constant in constants_of(graph):
        with graph.graph.inserting_after(after):
            after = graph.graph.placeholder(f"constant_{len(constants)}")
        node.replace_all_uses_with(after)
        graph.graph.erase_node(node)
        constants.append(constant.detach())
    graph.recompile()
    return constants


def constants_of(graph: GraphModule) -> list[tuple[Node, Tensor]]:
    """The tensors that a graph refers to without being given them."""
    found = [(node, getattr(graph, str(node.target))) for node in graph.graph.find_nodes(op="get_attr")]
    return [(node, x) for node, x in found if isinstance(x, Tensor)]


def _batch_products(graph: GraphModule) -> None:
    """Matrix products as batches of one: a CPU starts those sooner, and adds a bias in the kernel that comes next."""
    aten = torch.ops.aten

    def product(x: Tensor, y: Tensor) -> Tensor:
        return aten.squeeze.dim(aten.bmm.default(aten.unsqueeze.default(x, 0), aten.unsqueeze.default(y, 0)), 0)

    def biased(bias: Tensor, x: Tensor, y: Tensor) -> Tensor:
        return aten.add.Tensor(product(x, y), bias)

    replace_pattern(graph, lambda x, y: aten.mm.default(x, y), product)
    replace_pattern(graph, lambda bias, x, y: aten.addmm.default(bias, x, y), biased)


def _quick_tanh(graph: GraphModule) -> None:
    """The hyperbolic tangent of float32 by Lambert's continued fraction: the library's took a fifth of a PPO step.

    Twelve terms of x / (1 + x^2 / (3 + x^2 / (5 + ...))), as a quotient of polynomials in x^2, are right within 8
    roundings up to 8, where the tangent is 1 - 2e-7.
    """
    above, below = [1.0], [23.0]
    for odd in range(21, 0, -2):
        above, below = below, [odd * x + y for x, y in zip_longest(below, [0.0, *above], fillvalue=0.0)]
    tracer = GraphAppendingTracer(graph.graph)
    for node in graph.graph.find_nodes(op="call_function", target=torch.ops.aten.tanh.default):
        if node.meta["val"].dtype is torch.float32:
            with graph.graph.inserting_before(node):
                x = torch.ops.aten.clamp.default(Proxy(node.all_input_nodes[0], tracer), -8.0, 8.0)
                tanh = x * _polynomial(above, x * x) / _polynomial(below, x * x)
            node.replace_all_uses_with(tanh.node)
            graph.graph.erase_node(node)
    graph.recompile()


def _polynomial(coefficients: Sequence[float], x: Any) -> Any:
    *others, last = coefficients
    return reduce(lambda result, coefficient: result * x + coefficient, reversed(others), last)


def torch_compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``torch.compile(function)`` as one graph with gradients, for arguments like those of its first call alone.

    Later calls skip dynamo's guards.
    """

    def call(*arguments: Any) -> Any:
        return function(*arguments)

    # dynamo caches by code object: one of its own keeps each agent's graph apart from every other agent's
    code = call.__code__.replace(co_name=f"call_{id(call)}")
    own = types.FunctionType(code, call.__globals__, call.__name__, None, call.__closure__)
    traced = torch.compile(own, fullgraph=True, dynamic=False, options={"fallback_random": True})
    seen = False

    def run(*arguments: Any) -> Any:
        nonlocal seen
        if seen:
            with torch.compiler.set_stance("default", skip_guard_eval_unsafe=True):
                return traced(*arguments)
        with torch._dynamo.config.patch(trace_autograd_ops=True):
            result = traced(*arguments)
        seen = True
        return result

    return run
