"""A ``torch.optim`` optimizer as a function of gradients, working on its own parameters and state.

``Optimizer.step`` breaks a ``torch.compile`` graph on purpose; the functions under it do not. Each function here
applies one such function to the tensors of the optimizer's own ``state``, so that ``optimizer.state_dict()`` is true
at any time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.compiler import is_compiling
from torch.optim import LBFGS, SGD, Adam, AdamW, Optimizer, RMSprop
from torch.optim.adam import adam
from torch.optim.rmsprop import rmsprop
from torch.optim.sgd import sgd

from pgkit.compiled import computed_once
from pgkit.errors import UserError

Apply = Callable[[list[Tensor]], None]
Functional = tuple[Apply, Callable[[], None], list[Tensor]]


class Together:
    """Several optimizers as one: Muon for the matrices and Adam for the rest, say.

    Args:
        *parts: optimizers, each over parameters of its own.
    """

    def __init__(self, *parts: Optimizer) -> None:
        for part in parts:
            check_optimizer(part)
        self.parts = parts

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """The groups of all parts."""
        return [group for part in self.parts for group in part.param_groups]

    @property
    def state(self) -> dict[Tensor, Any]:
        """The state of every parameter."""
        return {p: state for part in self.parts for p, state in part.state.items()}

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Of all parts."""
        for part in self.parts:
            part.zero_grad(set_to_none)

    def step(self) -> None:
        """Of all parts."""
        for part in self.parts:
            part.step()

    def state_dict(self) -> dict[str, Any]:
        """The parts' own."""
        return {"parts": [part.state_dict() for part in self.parts]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        for part, own in zip(self.parts, state["parts"], strict=True):
            part.load_state_dict(own)


def check_optimizer(optimizer: Any) -> None:
    """A ``UserError`` for what is no optimizer over gradients: a list of them, a class, one that wants a closure."""
    if isinstance(optimizer, list | tuple):
        raise UserError("several optimizers are one block: updates.Together(first, second)")
    if not hasattr(optimizer, "param_groups"):
        raise UserError(f"optimizer is a {type(optimizer).__name__}: give torch.optim.Adam(loss.parameters(), lr=3e-4)")
    if isinstance(optimizer, LBFGS):
        raise UserError("LBFGS evaluates the loss several times a step, an update does once: use another optimizer")


def parameters(optimizer: Optimizer) -> list[Tensor]:
    """All parameters of the optimizer, in the order of its groups."""
    return [p for group in optimizer.param_groups for p in group["params"]]


def functional(optimizer: Any, fused: bool, params: list[Tensor] | None = None) -> Functional | None:
    """``(apply, read_learning_rates, rates)`` for Adam, AdamW, SGD and RMSprop, and for several of these ``Together``.

    None for any other optimizer, and for SGD with dampening.

    ``apply(grads)`` takes one gradient a parameter, in the order of :func:`parameters`, and can be traced.
    ``read_learning_rates()`` copies the groups' ``lr`` into the tensors ``rates`` that the trace uses, and a state
    that was reset (``optimizer.state.clear()``) into the tensors that it has: neither recompiles. Adam moments and
    counters are made here if the optimizer has none yet.

    Args:
        optimizer: of exactly one of the classes above.
        fused: use the fused kernel, which is fastest where nothing is compiled.
        params: step on these alone, in the order of :func:`parameters`; None: all.
    """
    if isinstance(optimizer, Together):
        return _together(optimizer, fused, parameters(optimizer) if params is None else params)
    make = {Adam: _adam, AdamW: _adam, SGD: _sgd, RMSprop: _rmsprop}.get(type(optimizer))
    unusual = ("capturable", "differentiable", "dampening")  # dampening leaves out the first step
    if make is None or any(group.get(name) for group in optimizer.param_groups for name in unusual):
        return None
    kept = {id(p) for p in (parameters(optimizer) if params is None else params)}
    groups = [{**g, "params": [p for p in g["params"] if id(p) in kept]} for g in optimizer.param_groups]
    sources, groups = zip(
        *[(s, g) for s, g in zip(optimizer.param_groups, groups, strict=True) if g["params"]], strict=True
    )
    rates = [torch.as_tensor(g["lr"], dtype=g["params"][0].dtype, device=g["params"][0].device) for g in groups]
    rates = [rate.clone() for rate in rates]
    applies = [make(optimizer, group, rate, fused) for group, rate in zip(groups, rates, strict=True)]

    state, names = optimizer.state, [name for name in optimizer.defaults if name != "lr"]
    held = [(p, name, x) for g in groups for p in g["params"] for name, x in state[p].items() if torch.is_tensor(x)]

    def read_learning_rates() -> None:
        if optimizer.state is not state:
            raise UserError(
                "the optimizer was loaded after its first step in this update: load it before, or load the update's "
                "own state (update.load_state_dict)"
            )
        for p, name, tensor in held:  # a state that was reset or replaced goes on in the tensors that the step has
            now = state[p].get(name)
            if now is not tensor:
                tensor.copy_(now) if torch.is_tensor(now) else tensor.zero_()
                state[p][name] = tensor
        for source, group, rate in zip(sources, groups, rates, strict=True):
            if changed := [name for name in names if source.get(name) != group.get(name)]:
                raise UserError(
                    f"the optimizer's {changed[0]} changed from {group[changed[0]]} to {source[changed[0]]}: while "
                    "training only lr may (OneCycleLR and CyclicLR: cycle_momentum=False); build a new update for "
                    "another value"
                )
            rate.fill_(source["lr"])

    return _in_turn(applies, [len(group["params"]) for group in groups]), read_learning_rates, rates


def _together(optimizer: Together, fused: bool, params: list[Tensor]) -> Functional | None:
    kept = {id(p) for p in params}
    owned = [[p for p in parameters(part) if id(p) in kept] for part in optimizer.parts]
    parts = [functional(part, fused, own) for part, own in zip(optimizer.parts, owned, strict=True) if own]
    if any(part is None for part in parts):
        return None
    applies, readers, rates = zip(*(part for part in parts if part is not None), strict=True)

    def read_learning_rates() -> None:
        for read in readers:
            read()

    return (
        _in_turn(applies, [len(own) for own in owned if own]),
        read_learning_rates,
        [rate for some in rates for rate in some],
    )


def _in_turn(applies: Sequence[Apply], sizes: Sequence[int]) -> Apply:
    """All of ``applies``, on so many gradients each."""

    def apply(grads: list[Tensor]) -> None:
        start = 0
        for size, apply_some in zip(sizes, applies, strict=True):
            apply_some(grads[start : start + size])
            start += size

    return apply


def _state(optimizer: Optimizer, group: dict[str, Any], *names: str) -> list[list[Tensor]]:
    """Lists of the named state tensors, one a parameter, made as the optimizer itself would at its first step."""
    for p in group["params"]:
        state = optimizer.state[p]
        for name in names:
            if state.get(name) is None:
                step = torch.zeros((), dtype=torch.promote_types(p.dtype, torch.float32), device=p.device)
                state[name] = step if name == "step" else torch.zeros_like(p, memory_format=torch.preserve_format)
    return [[optimizer.state[p][name] for p in group["params"]] for name in names]


def _adam(optimizer: Optimizer, group: dict[str, Any], lr: Tensor, fused: bool) -> Apply:
    names = ["exp_avg", "exp_avg_sq", "step", *(["max_exp_avg_sq"] if group["amsgrad"] else [])]
    averages, squares, steps, *maxima = _state(optimizer, group, *names)
    beta1, beta2 = group["betas"]

    def apply(grads: list[Tensor]) -> None:
        if is_compiling():
            traced(grads)
            return
        adam(
            group["params"], grads, averages, squares, maxima[0] if maxima else [], steps,
            foreach=False, fused=fused, amsgrad=group["amsgrad"], beta1=beta1, beta2=beta2,
            lr=lr, weight_decay=group["weight_decay"], eps=group["eps"], maximize=group["maximize"],
            decoupled_weight_decay=group.get("decoupled_weight_decay", False),
        )  # fmt: skip

    def traced(grads: list[Tensor]) -> None:  # the same, with the bias corrections of all parameters at once
        counts = torch.stack([step.add_(1) for step in steps]).double()  # as precise as the eager step's numbers
        rates = computed_once((lr / (1 - beta1**counts)).to(lr.dtype))
        roots = computed_once((1 - beta2**counts).sqrt().to(lr.dtype))
        decay, decoupled = group["weight_decay"], group.get("decoupled_weight_decay", False)
        for i, (p, grad, average, square) in enumerate(zip(group["params"], grads, averages, squares, strict=True)):
            grad = -grad if group["maximize"] else grad
            if decay and decoupled:
                p.mul_(1 - lr * decay)
            elif decay:
                grad = grad + decay * p
            average.lerp_(grad, 1 - beta1)
            square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
            if maxima:
                square = maxima[0][i].copy_(torch.maximum(maxima[0][i], square))
            p.sub_(rates[i] * average / (square.sqrt() / roots[i] + group["eps"]))

    return apply


def _sgd(optimizer: Optimizer, group: dict[str, Any], lr: Tensor, fused: bool) -> Apply:
    names = ["momentum_buffer"] if group["momentum"] else []
    buffers = _state(optimizer, group, *names)

    def step(params: list[Tensor], grads: list[Tensor], lr: Any, weight_decay: float, maximize: bool) -> None:
        sgd(
            params, grads, buffers[0] if buffers else [None] * len(grads),
            foreach=False, fused=False, weight_decay=weight_decay, momentum=group["momentum"], lr=lr,
            dampening=0.0, nesterov=group["nesterov"], maximize=maximize,
        )  # fmt: skip

    return _at_a_tensor_s_rate(step, group, lr)


def _rmsprop(optimizer: Optimizer, group: dict[str, Any], lr: Tensor, fused: bool) -> Apply:
    names = ["square_avg", "step"]
    names += ["momentum_buffer"] if group["momentum"] else []
    names += ["grad_avg"] if group["centered"] else []
    state = dict(zip(names, _state(optimizer, group, *names), strict=True))

    def step(params: list[Tensor], grads: list[Tensor], lr: Any, weight_decay: float, maximize: bool) -> None:
        rmsprop(
            params, grads, state["square_avg"], state.get("grad_avg", []), state.get("momentum_buffer", []),
            state["step"], foreach=False, capturable=is_compiling(), lr=lr, alpha=group["alpha"], eps=group["eps"],
            weight_decay=weight_decay, momentum=group["momentum"], centered=group["centered"], maximize=maximize,
        )  # fmt: skip

    return _at_a_tensor_s_rate(step, group, lr)


def _at_a_tensor_s_rate(step: Callable[..., None], group: dict[str, Any], lr: Tensor) -> Apply:
    """``step`` for a function of torch that turns the learning rate into a number, which would end up in the graph."""
    params, weight_decay, maximize = group["params"], group["weight_decay"], group["maximize"]

    def apply(grads: list[Tensor]) -> None:
        if not is_compiling():
            step(params, grads, lr, weight_decay, maximize)
            return
        grads = [-grad if maximize else grad for grad in grads]
        if weight_decay:
            grads = [grad + weight_decay * p for grad, p in zip(grads, params, strict=True)]
        moves = [torch.zeros_like(p) for p in params]
        step(moves, grads, 1.0, 0.0, False)
        for p, move in zip(params, moves, strict=True):
            p.add_(lr * move)

    return apply
