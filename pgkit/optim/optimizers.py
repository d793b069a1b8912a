"""The user's ``torch.optim`` optimizers: several as one, what may train, and a step outside the graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torch.optim import LBFGS, Adam, AdamW, Optimizer

from pgkit.errors import UserError


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


def parts(optimizer: Optimizer | Together) -> Sequence[Optimizer]:
    """The optimizers that this is: the parts of :class:`Together`, or itself."""
    return optimizer.parts if isinstance(optimizer, Together) else [optimizer]


def step(optimizer: Optimizer | Together, params: Sequence[Tensor], grads: Sequence[Tensor]) -> None:
    """The optimizer's own step on these gradients alone; a parameter that is not among ``params`` stays.

    Adam and AdamW take torch's fused kernel, the fastest, unless the user chose another.
    """
    for param in parameters(optimizer):
        param.grad = None
    for param, grad in zip(params, grads, strict=True):
        param.grad = grad
    adams = [(group, part) for part in parts(optimizer) if type(part) in (Adam, AdamW) for group in part.param_groups]
    fused = [(g, part) for g, part in adams if g["fused"] is g["foreach"] is None and not g["differentiable"]]
    for group, part in fused:
        group["fused"] = True
        for own, device in ((part.state.get(p, {}), p.device) for p in group["params"]):
            if "step" in own:  # loaded, or made by an unfused step: torch keeps such a counter on the CPU
                own["step"] = own["step"].to(device)
    try:
        optimizer.step()
    finally:
        for group, _ in fused:
            group["fused"] = None
