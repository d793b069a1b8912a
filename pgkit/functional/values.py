"""Losses of value functions, unreduced, and what makes numbers comparable."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from pgkit.functional.checks import same_shape

Distance = Callable[[Tensor, Tensor], Tensor]
_DISTANCES = {"l2": F.mse_loss, "l1": F.l1_loss, "smooth_l1": F.smooth_l1_loss}


def value_loss(value: Tensor, target: Tensor, kind: str | Distance = "l2") -> Tensor:
    """Distance of a prediction from its target: ``l2`` (squared error, no factor 1/2), ``l1`` or ``smooth_l1``.

    Or a function of one's own, ``kind(value, target)``, unreduced. Same shape in and out; raises ``ValueError`` for two
    shapes or an unknown kind.
    """
    same_shape(value=value, target=target)
    if not isinstance(kind, str):
        return kind(value, target)
    if kind not in _DISTANCES:
        raise ValueError(f"unknown value loss '{kind}': choose one of {', '.join(_DISTANCES)}")
    return _DISTANCES[kind](value, target, reduction="none")


def clipped_value_loss(
    value: Tensor, target: Tensor, old_value: Tensor, clip: float | Tensor, kind: str | Distance = "l2"
) -> Tensor:
    r"""The larger of the losses of :math:`V` and of :math:`V_{old} + \text{clip}(V - V_{old}, \pm\epsilon)`.

    PPO's value clipping as in OpenAI's baselines; see Engstrom et al., 2020 (https://arxiv.org/abs/2005.12729)
    for what it does. All of one shape, unreduced.
    """
    same_shape(value=value, old_value=old_value)
    clipped = old_value + (value - old_value).clamp(-clip, clip)
    return torch.maximum(value_loss(value, target, kind), value_loss(clipped, target, kind))


def standardize(x: Tensor, mask: Tensor | None = None, dim: Sequence[int] | None = None) -> Tensor:
    """``x`` with zero mean and unit deviation over its elements, or over those of ``mask``, of its shape.

    With ``dim``, over these dimensions only: every index of the others has a mean and a deviation of its own.
    A single element becomes zero; a deviation below 1e-6 counts as that.
    """
    centered, squares, count = _centered(x, mask, dim)
    deviation = (squares / (count - 1).clamp_min(1)).sqrt()
    return centered / deviation.clamp_min(1e-6)


def explained_variance(value: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    r""":math:`1 - \text{Var}(target - V) / \text{Var}(target)`: 1 is perfect, 0 no better than the mean. A scalar.

    Over all elements, or over those of ``mask``, of the same shape.
    """
    same_shape(value=value, target=target)
    _, unexplained, count = _centered(target - value, mask)
    _, total, _ = _centered(target, mask)
    return 1 - unexplained / total.clamp_min(1e-12 * count)


def _centered(x: Tensor, mask: Tensor | None, dim: Sequence[int] | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """``x`` less its mean, the sum of the squares of that, and how many elements count."""
    axes = list(range(x.dim()) if dim is None else dim)

    def total(y: Tensor) -> Tensor:
        y = y if mask is None else y.masked_fill(~mask, 0.0)  # a masked element may be NaN
        return y.sum(axes, keepdim=dim is not None)

    count = total(torch.ones_like(x)).clamp_min(1)  # where none counts, the mean is 0
    centered = x - total(x) / count
    return centered, total(centered.square()), count
