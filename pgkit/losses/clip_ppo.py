"""PPO with a clipped surrogate (Schulman et al., 2017, https://arxiv.org/abs/1707.06347)."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from typing_extensions import Unpack

from pgkit.errors import within
from pgkit.functional import approx_kl, clip_surrogate, same_shape
from pgkit.losses.policy_base import PolicyLoss, PolicySettings

Surrogate = Callable[[Tensor, Tensor], Tensor]


class ClipPPOLoss(PolicyLoss):
    r"""Clipped PPO, a drop-in for TorchRL's loss of that name.

    .. math::
        L = -\frac1B \sum \min\big(r A, \text{clip}(r, 1-\epsilon, 1+\epsilon) A\big)
            + c_V \frac1B \sum (V - V^{target})^2 - c_H \frac1B \sum H[\pi]

    Defaults that differ from TorchRL's: the value loss is the squared error (there ``smooth_l1``), the advantage is
    normalized in every minibatch (there it is not), the entropy coefficient is 0 (there 0.01).

    Args:
        actor_network: probabilistic actor.
        critic_network: value operator; None leaves the value loss out.
        clip_epsilon: :math:`\epsilon`, the buffer ``clip_epsilon``; or a pair, the buffers ``clip_epsilon_low`` and
            ``clip_epsilon_high``.
        surrogate: replaces the clipped surrogate: ``(log_ratio, advantage) -> objective``, unreduced, to be
            maximized, all ``[*B, 1]``.
        clip_value: clip the value's change to this distance from ``state_value``; True takes ``clip_epsilon``.
        settings: those of :class:`~pgkit.losses.PolicyLoss`; ``normalize_advantage`` is True by default.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and the metrics ``entropy``, ``approx_kl``,
    ``clip_fraction``, ``explained_variance``.
    """

    _schedulable_buffers: ClassVar[frozenset[str]] = PolicyLoss._schedulable_buffers | {
        "clip_epsilon",
        "clip_epsilon_low",
        "clip_epsilon_high",
    }

    clip_epsilon: Tensor | None
    clip_epsilon_low: Tensor
    clip_epsilon_high: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule | None = None,
        *,
        clip_epsilon: float | tuple[float, float] = 0.2,
        surrogate: Surrogate | None = None,
        **settings: Unpack[PolicySettings],
    ) -> None:
        low, high = clip_epsilon if isinstance(clip_epsilon, tuple | list) else (clip_epsilon, clip_epsilon)
        within(0, float("inf"), clip_epsilon=low)
        within(0, float("inf"), clip_epsilon=high)
        if settings.get("clip_value") is True and low != high:
            raise ValueError(
                "clip_value=True takes clip_epsilon's value, which is a pair here: give clip_value a number"
            )
        clip_value = settings.get("clip_value")
        settings["clip_value"] = low if clip_value is True else clip_value or None
        super().__init__(actor_network, critic_network, **(PolicySettings(normalize_advantage=True) | settings))
        one = not isinstance(clip_epsilon, tuple | list)
        self.register_coeff_buffer("clip_epsilon", low if one else None, dtype=torch.float64)
        self.register_coeff_buffer("clip_epsilon_low", None if one else low, dtype=torch.float64)
        self.register_coeff_buffer("clip_epsilon_high", None if one else high, dtype=torch.float64)
        self.surrogate = surrogate

    @property
    def clip_bounds(self) -> tuple[Tensor, Tensor]:
        """How far the ratio may fall below 1 and rise above it."""
        if self.clip_epsilon is None:
            return self.clip_epsilon_low, self.clip_epsilon_high
        return self.clip_epsilon, self.clip_epsilon

    def _writes(self) -> list[NestedKey]:
        return [*super()._writes(), "approx_kl", "clip_fraction"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` with ``advantage`` ``[*B, 1]``."""
        batch = tensordict.copy()
        advantage, dist = self.get_advantage(batch), self.distribution(batch)
        log_ratio, (low, high) = self.log_ratio(dist, batch), self.clip_bounds
        if self.surrogate is None:
            objective = clip_surrogate(log_ratio, advantage, low, high)
        else:
            objective = self.surrogate(log_ratio, advantage)
        same_shape(advantage=advantage, surrogate=objective)

        out = self.result(batch, objective, dist)
        ratio = log_ratio.detach().exp()
        out["approx_kl"] = self.average(approx_kl(log_ratio), batch)
        out["clip_fraction"] = self.average(((ratio < 1 - low) | (ratio > 1 + high)).to(ratio.dtype), batch)
        return out
