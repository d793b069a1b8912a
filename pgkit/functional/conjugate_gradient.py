"""Solving a linear system of which only the product is known."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def conjugate_gradient(
    product: Callable[[Tensor], Tensor], b: Tensor, steps: int = 10, tolerance: float = 1e-10
) -> tuple[Tensor, Tensor]:
    r"""Solves :math:`A x = b`, :math:`A` symmetric positive definite, from :math:`x = 0` (Hestenes and Stiefel, 1952).

    Args:
        product: :math:`v \mapsto A v`, ``[n]`` to ``[n]``.
        b: ``[n]``.
        steps: at most so many products.
        tolerance: stop when :math:`|A x - b|^2` is below this share of :math:`|b|^2`.

    Returns:
        :math:`x`, ``[n]``, and :math:`|A x - b|^2 / |b|^2`, a scalar.
    """
    x, residual, direction = torch.zeros_like(b), b.clone(), b.clone()
    error = start = b @ b
    for _ in range(steps):
        if error <= tolerance * start:
            break
        image = product(direction)
        length = error / (direction @ image)
        x, residual = x + length * direction, residual - length * image
        last, error = error, residual @ residual
        direction = residual + error / last * direction
    return x, error / start.clamp_min(torch.finfo(b.dtype).tiny)
