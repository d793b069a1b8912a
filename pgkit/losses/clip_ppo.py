"""PPO with a clipped surrogate (Schulman et al., 2017, https://arxiv.org/abs/1707.06347)."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from pgkit.errors import within
from pgkit.functional import approx_kl, clip_surrogate, same_shape
from pgkit.functional.values import Distance
from pgkit.losses.actor_critic_base import ActorCriticLoss

Surrogate = Callable[[Tensor, Tensor], Tensor]


class ClipPPOLoss(ActorCriticLoss):
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
        entropy_coeff, critic_coeff, loss_critic_type, normalize_advantage, entropy_bonus, samples_mc_entropy,
            separate_losses, reduction: as in :class:`~pgkit.losses.ActorCriticLoss`.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and the metrics ``entropy``, ``approx_kl``,
    ``clip_fraction``, ``explained_variance``.
    """

    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset(
        {"clip_epsilon", "clip_epsilon_low", "clip_epsilon_high", "entropy_coeff", "critic_coeff", "clip_value"}
    )

    clip_epsilon: Tensor
    clip_epsilon_low: Tensor
    clip_epsilon_high: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule | None = None,
        *,
        clip_epsilon: float | tuple[float, float] = 0.2,
        surrogate: Surrogate | None = None,
        entropy_coeff: float = 0.0,
        critic_coeff: float | None = 1.0,
        loss_critic_type: str | Distance = "l2",
        normalize_advantage: bool = True,
        clip_value: bool | float | None = None,
        entropy_bonus: bool = True,
        samples_mc_entropy: int = 1,
        separate_losses: bool = False,
        reduction: str | None = None,
    ) -> None:
        pair = isinstance(clip_epsilon, tuple | list)
        low, high = clip_epsilon if pair else (clip_epsilon, clip_epsilon)
        within(0, float("inf"), clip_epsilon=low)
        within(0, float("inf"), clip_epsilon=high)
        if clip_value is True and low != high:
            raise ValueError(
                "clip_value=True takes clip_epsilon's value, which is a pair here: give clip_value a number"
            )
        super().__init__(
            actor_network, critic_network, entropy_coeff=entropy_coeff, critic_coeff=critic_coeff,
            loss_critic_type=loss_critic_type, normalize_advantage=normalize_advantage,
            clip_value=low if clip_value is True else clip_value or None, entropy_bonus=entropy_bonus,
            samples_mc_entropy=samples_mc_entropy, separate_losses=separate_losses, reduction=reduction,
        )  # fmt: skip
        self._clip_names = ("clip_epsilon_low", "clip_epsilon_high") if pair else ("clip_epsilon", "clip_epsilon")
        for name, value in zip(self._clip_names[: 1 + pair], (low, high), strict=False):
            self.register_coeff_buffer(name, value)
        self.surrogate = surrogate

    @property
    def clip_bounds(self) -> tuple[Tensor, Tensor]:
        """How far the ratio may fall below 1 and rise above it."""
        low, high = self._clip_names
        return getattr(self, low), getattr(self, high)

    def _writes(self) -> list[NestedKey]:
        return ["loss_objective", *super()._writes(), "approx_kl", "clip_fraction"]

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

        out = TensorDict({"loss_objective": self.reduce(-objective, batch)})
        self.add_entropy(out, dist, batch)
        self.add_critic(out, batch)

        ratio = log_ratio.detach().exp()
        out["approx_kl"] = self.average(approx_kl(log_ratio), batch)
        out["clip_fraction"] = self.average(((ratio < 1 - low) | (ratio > 1 + high)).to(ratio.dtype), batch)
        return out
