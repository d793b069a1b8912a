"""SAC's temperature: what sets the weight of the entropy while it trains."""

from __future__ import annotations

from math import log

import torch
from torch import Tensor, nn

from pgkit.errors import UserError
from pgkit.functional import temperature_loss


class Temperature(nn.Module):
    r"""Temperature :math:`\alpha` that is trained to hold the policy's entropy at a target.

    Give it to :class:`pgkit.losses.SACLoss` (``temperature=``) and its parameter to the optimizer. Any module with
    these two does as well: ``alpha`` (a detached scalar) and ``loss(log_prob [*B]) -> [*B]``.

    Args:
        target_entropy: :math:`\bar H` in nats; by custom minus the number of action dimensions, for actions in [-1, 1]:
            add the log of half the range of each dimension for others.
        alpha_init: its value at the start, above 0.
        min_alpha, max_alpha: bounds of :math:`\alpha`; None: none.
        trained: False keeps it constant, as a buffer.
    """

    log_alpha: Tensor
    target_entropy: Tensor

    def __init__(
        self,
        target_entropy: float,
        alpha_init: float = 1.0,
        *,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        trained: bool = True,
    ) -> None:
        super().__init__()
        if alpha_init <= 0:
            raise UserError(f"alpha_init={alpha_init:g}: give a number above 0 (FixedTemperature(0) for none)")
        self.register_buffer(
            "target_entropy", torch.tensor(float(target_entropy), dtype=torch.float64), persistent=False
        )
        self.bounds = (log(min_alpha) if min_alpha else None, log(max_alpha) if max_alpha else None)
        if trained:
            self.log_alpha = nn.Parameter(torch.tensor(log(alpha_init)))  # float32: a compiled step writes it
        else:
            self.register_buffer("log_alpha", torch.tensor(log(alpha_init), dtype=torch.float64))

    @property
    def alpha(self) -> Tensor:
        """The temperature, a detached scalar; ``log_alpha`` is put back within its bounds first."""
        with torch.no_grad():
            return (self.log_alpha if self.bounds == (None, None) else self.log_alpha.clamp_(*self.bounds)).exp()

    def loss(self, log_prob: Tensor) -> Tensor:
        """Loss ``[*B]`` of the log-probabilities ``[*B]`` of actions that the policy drew now."""
        return temperature_loss(self.log_alpha, log_prob, self.target_entropy)


class FixedTemperature(nn.Module):
    """A constant temperature: nothing to train, the loss is zero.

    Args:
        alpha: its value.
    """

    alpha: Tensor

    def __init__(self, alpha: float) -> None:
        super().__init__()
        self.register_buffer("alpha", torch.tensor(float(alpha), dtype=torch.float64))

    def loss(self, log_prob: Tensor) -> Tensor:
        """Zeros ``[*B]``."""
        return torch.zeros_like(log_prob)
