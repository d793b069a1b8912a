"""The rules of an optimizer, bound to its own parameters and state, as a part of the compiled graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim import SGD, Adam, AdamW, Optimizer, RMSprop

from pgkit.errors import UserError
from pgkit.optim.optimizers import Together, parameters, parts
from pgkit.optim.rules import Rule, adam, rmsprop, sgd

RULES: dict[type[Optimizer], Callable[..., Rule]] = {Adam: adam, AdamW: adam, SGD: sgd, RMSprop: rmsprop}
_NOT_IN_GRAPH = ("capturable", "differentiable", "dampening")
_FREE = ("lr", "foreach", "fused")  # a tensor of the graph, and how torch itself would step


def bound(optimizer: Optimizer | Together, params: Sequence[Tensor] | None = None) -> Bound | None:
    """The optimizer's arithmetic for a graph; None where it has no rule: it then steps outside (:func:`step`).

    Adam, AdamW, SGD without dampening and RMSprop have one, and several of these ``Together``.

    Args:
        optimizer: of exactly one of the classes above.
        params: step on these alone; None: all.
    """
    unusual = (group.get(name) for group in optimizer.param_groups for name in _NOT_IN_GRAPH)
    if any(type(part) not in RULES for part in parts(optimizer)) or any(unusual):
        return None
    kept = {id(p) for p in (parameters(optimizer) if params is None else params)}
    groups = []
    for part in parts(optimizer):
        for position, group in enumerate(part.param_groups):
            if own := [p for p in group["params"] if id(p) in kept]:
                groups.append(_Group(part, position, own))
    return Bound(groups)


class Bound:
    """``apply(grads)``: one step of the optimizer in tensor operations that can be recorded.

    Attributes:
        params: the parameters it steps on, in the order of :func:`parameters`.
        tensors: what it reads and changes besides: the optimizer's state, made here where there is none, and the
            learning rates.
    """

    def __init__(self, groups: Sequence[_Group]) -> None:
        self._groups = groups
        self.params = [p for group in groups for p in group.params]
        self.tensors = [x for group in groups for xs in (*group.state.values(), [group.lr]) for x in xs]

    def read(self) -> None:
        """Takes over the learning rates, and a state that was reset or loaded; call it before a series of steps.

        Raises:
            UserError: another setting of the optimizer changed, which is a constant of the graph.
        """
        for group in self._groups:
            group.read()

    @torch.no_grad()
    def apply(self, grads: Sequence[Tensor], finite: Tensor | None = None) -> None:
        """Steps on the gradients of :attr:`params`.

        Args:
            finite: 0-dim bool; where it is False, parameters and state stay as they are. None: always step.
        """
        start = 0
        for group in self._groups:
            group.apply(list(grads[start : start + len(group.params)]), finite)
            start += len(group.params)


class _Group:
    """One parameter group: its rule, and the tensors of its optimizer's state."""

    def __init__(self, optimizer: Optimizer, position: int, params: list[Tensor]) -> None:
        self.optimizer, self.position, self.params = optimizer, position, params
        self.settings = self._settings()
        self.rule = RULES[type(optimizer)](**self.settings)
        for p in params:
            own = optimizer.state[p]
            for name, made in self.rule.init(p).items():  # a counter of torch's may be on the CPU
                own[name] = made if own.get(name) is None else own[name].to(p.device)
        names = self.rule.init(params[0])
        self.state = {name: [optimizer.state[p][name] for p in params] for name in names}
        self.lr = torch.zeros((), dtype=params[0].dtype, device=params[0].device)
        self.read()

    def _settings(self) -> dict[str, Any]:
        group = self.optimizer.param_groups[self.position]
        return {name: group.get(name) for name in self.optimizer.defaults if name not in _FREE}

    def read(self) -> None:
        now = self._settings()
        for name, old in self.settings.items():
            if now[name] != old:
                raise UserError(
                    f"the optimizer's {name} changed from {old} to {now[name]}: while training only lr may (OneCycleLR "
                    "and CyclicLR: cycle_momentum=False); build a new update for another value"
                )
        for name, tensors in self.state.items():
            for p, tensor in zip(self.params, tensors, strict=True):
                own = self.optimizer.state[p]
                if own.get(name) is not tensor:  # the graph goes on in the tensors that it has
                    tensor.zero_() if own.get(name) is None else tensor.copy_(own[name])
                    own[name] = tensor
        self.lr.fill_(self.optimizer.param_groups[self.position]["lr"])
        self.optimizer._opt_called = True  # torch's schedulers look here before they warn that no step was taken

    def apply(self, grads: list[Tensor], finite: Tensor | None) -> None:
        params, state = self.rule.update(grads, self.state, self.params, self.lr)
        for new, old in [(params, self.params), *((state[name], self.state[name]) for name in state)]:
            for x, tensor in zip(new, old, strict=True):
                tensor.copy_(x if finite is None else torch.where(finite, x, tensor))
