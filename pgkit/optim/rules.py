"""Optimizer rules as pairs of pure functions, optax's ``GradientTransformation``, for the compiled graph.

A rule's state has the names of torch's own, so that it works on the tensors of a ``torch.optim`` optimizer. Unlike
optax's, ``update`` gives the new parameters and not their change: AdamW's decay then rounds as torch's does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pgkit.optim.once import computed_once

Tensors = list[Tensor]
State = dict[str, Tensors]


class Rule(NamedTuple):
    """One optimizer's arithmetic.

    Attributes:
        init: ``init(param) -> {name: tensor}``, the state of one parameter before its first step.
        update: ``update(grads, state, params, lr) -> (params, state)`` of many parameters, their state by name; pure.
    """

    init: Callable[[Tensor], dict[str, Tensor]]
    update: Callable[[Tensors, State, Tensors, Tensor], tuple[Tensors, State]]


def adam(
    betas: tuple[float, float], eps: float, weight_decay: float, amsgrad: bool, maximize: bool,
    decoupled_weight_decay: bool = False, **_: Any,
) -> Rule:  # fmt: skip
    r"""Adam (Kingma & Ba, 2015, https://arxiv.org/abs/1412.6980), AMSGrad and AdamW with it.

    .. math::
        m_t &= \beta_1 m_{t-1} + (1 - \beta_1) g_t, \qquad v_t = \beta_2 v_{t-1} + (1 - \beta_2) g_t^2, \\
        \theta_t &= \theta_{t-1}
        - \frac{\alpha}{1 - \beta_1^t} \, m_t \Big/ \Big(\frac{\sqrt{v_t}}{\sqrt{1 - \beta_2^t}} + \epsilon\Big)
    """
    beta1, beta2 = betas
    names = ["step", "exp_avg", "exp_avg_sq", *(["max_exp_avg_sq"] if amsgrad else [])]

    def update(grads: Tensors, state: State, params: Tensors, lr: Tensor) -> tuple[Tensors, State]:
        steps = [step + 1 for step in state["step"]]
        counts = torch.stack(steps).double()  # the corrections of all parameters at once, as precise as torch's numbers
        rates = computed_once((lr / (1 - beta1**counts)).to(lr.dtype))
        roots = computed_once((1 - beta2**counts).sqrt().to(lr.dtype))
        grads = _adjusted(grads, params, maximize, 0.0 if decoupled_weight_decay else weight_decay)
        if decoupled_weight_decay:
            params = [p * (1 - lr * weight_decay) for p in params]
        averages = [average.lerp(grad, 1 - beta1) for average, grad in zip(state["exp_avg"], grads, strict=True)]
        squares = _running_squares(state["exp_avg_sq"], grads, beta2)
        new = {"step": steps, "exp_avg": averages, "exp_avg_sq": squares}
        if amsgrad:
            squares = [torch.maximum(*pair) for pair in zip(state["max_exp_avg_sq"], squares, strict=True)]
            new["max_exp_avg_sq"] = squares
        moved = zip(params, averages, squares, rates, roots, strict=True)
        return [p - rate * average / (square.sqrt() / root + eps) for p, average, square, rate, root in moved], new

    return Rule(lambda p: _zeros(p, names), update)


def sgd(momentum: float, weight_decay: float, nesterov: bool, maximize: bool, **_: Any) -> Rule:
    r"""Stochastic gradient descent, :math:`b_t = \mu b_{t-1} + g_t, \; \theta_t = \theta_{t-1} - \alpha b_t`.

    With ``nesterov`` the step is :math:`g_t + \mu b_t` (Sutskever et al., 2013). There is no dampening: torch leaves it
    out of the first step.
    """

    def update(grads: Tensors, state: State, params: Tensors, lr: Tensor) -> tuple[Tensors, State]:
        grads, new = _adjusted(grads, params, maximize, weight_decay), {}
        if momentum:
            buffers = [b * momentum + grad for b, grad in zip(state["momentum_buffer"], grads, strict=True)]
            new["momentum_buffer"] = buffers
            grads = [g + momentum * b for g, b in zip(grads, buffers, strict=True)] if nesterov else buffers
        return [p - lr * grad for p, grad in zip(params, grads, strict=True)], new

    return Rule(lambda p: _zeros(p, ["momentum_buffer"] if momentum else []), update)


def rmsprop(
    alpha: float, eps: float, weight_decay: float, momentum: float, centered: bool, maximize: bool, **_: Any
) -> Rule:
    r"""RMSprop (Tieleman & Hinton, 2012), centered as in Graves (2013, https://arxiv.org/abs/1308.0850).

    .. math::
        v_t = \alpha v_{t-1} + (1 - \alpha) g_t^2, \qquad
        \theta_t = \theta_{t-1} - \text{lr} \, g_t / (\sqrt{v_t - \bar g_t^2} + \epsilon)
    """
    names = ["step", "square_avg", *(["momentum_buffer"] if momentum else []), *(["grad_avg"] if centered else [])]

    def update(grads: Tensors, state: State, params: Tensors, lr: Tensor) -> tuple[Tensors, State]:
        grads = _adjusted(grads, params, maximize, weight_decay)
        squares = _running_squares(state["square_avg"], grads, alpha)
        new = {"step": [step + 1 for step in state["step"]], "square_avg": squares}
        if centered:
            means = [mean.lerp(grad, 1 - alpha) for mean, grad in zip(state["grad_avg"], grads, strict=True)]
            new["grad_avg"] = means
            squares = [square.addcmul(mean, mean, value=-1) for square, mean in zip(squares, means, strict=True)]
        moves = [grad / (square.sqrt() + eps) for grad, square in zip(grads, squares, strict=True)]
        if momentum:
            moves = [b * momentum + move for b, move in zip(state["momentum_buffer"], moves, strict=True)]
            new["momentum_buffer"] = moves
        return [p - lr * move for p, move in zip(params, moves, strict=True)], new

    return Rule(lambda p: _zeros(p, names), update)


def _zeros(p: Tensor, names: Sequence[str]) -> dict[str, Tensor]:
    """As torch makes them: a counter in float32, everything else like the parameter."""
    count = torch.zeros((), dtype=torch.float32, device=p.device)
    return {name: count if name == "step" else torch.zeros_like(p, requires_grad=False) for name in names}


def _adjusted(grads: Tensors, params: Tensors, maximize: bool, decay: float) -> Tensors:
    """The gradients downhill, with those of the weights' squares."""
    grads = [-grad for grad in grads] if maximize else grads
    return [grad + decay * p for grad, p in zip(grads, params, strict=True)] if decay else grads


def _running_squares(squares: Tensors, grads: Tensors, keep: float) -> Tensors:
    return [v.mul(keep).addcmul(grad, grad, value=1 - keep) for v, grad in zip(squares, grads, strict=True)]
