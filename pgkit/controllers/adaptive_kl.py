"""The weight of PPO's KL penalty: what keeps the policy's steps at a given size."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pgkit.functional import adapted_coefficient


class AdaptiveKL(nn.Module):
    r"""A coefficient :math:`\beta` that doubles when the KL divergence was too large, and halves when it was too small.

    Give it to :class:`pgkit.losses.KLPENPPOLoss` (``controller=``) and call :meth:`update` once a rollout. Any module
    with a scalar tensor ``beta`` does as well. :math:`\beta` is a buffer: it travels in the checkpoint, and its change
    compiles nothing again.

    Args:
        target: KL divergence between the policies before and after an update, :math:`d_{targ}`.
        beta: :math:`\beta` at the start.
        increment, decrement: factors of :math:`\beta` for a KL above 1.5, below 1 / 1.5 times the target.
        bounds: :math:`\beta` stays within these.
    """

    beta: Tensor

    def __init__(
        self,
        target: float = 0.01,
        beta: float = 1.0,
        *,
        increment: float = 2.0,
        decrement: float = 0.5,
        bounds: tuple[float, float] = (1e-4, 1e4),
    ) -> None:
        super().__init__()
        self.target, self.increment, self.decrement, self.bounds = target, increment, decrement, bounds
        self.register_buffer("beta", torch.tensor(float(beta), dtype=torch.float64))

    @torch.no_grad()
    def update(self, kl: Tensor) -> float:
        """Takes in the divergence after an update, any shape (its mean counts); returns the new :math:`\\beta`."""
        beta = adapted_coefficient(self.beta, kl.mean(), self.target, self.increment, self.decrement)
        return float(self.beta.copy_(beta.clamp(*self.bounds)))


class FixedKL(nn.Module):
    """A constant coefficient.

    Args:
        beta: its value.
    """

    beta: Tensor

    def __init__(self, beta: float) -> None:
        super().__init__()
        self.register_buffer("beta", torch.tensor(float(beta), dtype=torch.float64))

    def update(self, kl: Tensor) -> float:
        """Returns the coefficient."""
        return float(self.beta)
