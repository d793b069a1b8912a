"""PPO with a clipped surrogate (Schulman et al., 2017, https://arxiv.org/abs/1707.06347)."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from pgkit.functional import (
    approx_kl,
    clip_surrogate,
    clipped_value_loss,
    explained_variance,
    same_shape,
    value_loss,
)
from pgkit.losses.policy_base import PolicyLoss, standardize

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
        clip_epsilon: :math:`\epsilon`, or a pair ``(low, high)``.
        surrogate: replaces the clipped surrogate: ``(log_ratio, advantage) -> objective``, unreduced, to be
            maximized, all ``[*B, 1]``.
        entropy_coeff: :math:`c_H`.
        critic_coeff: :math:`c_V`.
        loss_critic_type: ``l2``, ``l1`` or ``smooth_l1``.
        normalize_advantage: zero mean and unit deviation within the minibatch.
        clip_value: clip the value's change to this distance from ``state_value``; True takes ``clip_epsilon``.
        entropy_bonus: False leaves entropy out altogether.
        separate_losses: parameters shared by actor and critic are trained by the policy's loss only.
        reduction: ``mean``, ``sum`` or ``none``.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and the metrics ``entropy``, ``approx_kl``,
    ``clip_fraction``, ``explained_variance``.
    """

    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset(
        {"clip_low", "clip_high", "entropy_coeff", "critic_coeff", "clip_value"}
    )

    clip_low: Tensor
    clip_high: Tensor
    entropy_coeff: Tensor
    critic_coeff: Tensor
    clip_value: Tensor | None

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule | None = None,
        *,
        clip_epsilon: float | tuple[float, float] = 0.2,
        surrogate: Surrogate | None = None,
        entropy_coeff: float = 0.0,
        critic_coeff: float | None = 1.0,
        loss_critic_type: str = "l2",
        normalize_advantage: bool = True,
        clip_value: bool | float | None = None,
        entropy_bonus: bool = True,
        separate_losses: bool = False,
        reduction: str | None = None,
    ) -> None:
        critic = critic_network if critic_coeff else None
        super().__init__(actor_network, critic, separate_losses=separate_losses, reduction=reduction)
        low, high = clip_epsilon if isinstance(clip_epsilon, tuple | list) else (clip_epsilon, clip_epsilon)
        if clip_value is True and low != high:
            raise ValueError(
                "clip_value=True takes clip_epsilon's value, which is a pair here: give clip_value a number"
            )
        self.register_coeff_buffer("clip_low", low)
        self.register_coeff_buffer("clip_high", high)
        self.register_coeff_buffer("entropy_coeff", entropy_coeff)
        self.register_coeff_buffer("critic_coeff", critic_coeff)
        self.register_coeff_buffer("clip_value", low if clip_value is True else clip_value or None)
        self.surrogate = surrogate
        self.loss_critic_type, self.normalize_advantage = loss_critic_type, normalize_advantage
        self.entropy_bonus = entropy_bonus

    def _writes(self) -> list[NestedKey]:
        entropy = ["loss_entropy", "entropy"] if self.entropy_bonus else []
        critic = [] if self.critic_network is None else ["loss_critic", "explained_variance"]
        return ["loss_objective", *entropy, *critic, "approx_kl", "clip_fraction"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` with ``advantage`` ``[*B, 1]``."""
        batch = tensordict.copy()
        advantage = self.get_advantage(batch)
        if self.normalize_advantage and advantage.numel() > 1:
            advantage = standardize(advantage)

        dist = self.distribution(batch)
        log_prob = dist.log_prob(batch[self.tensor_keys.action])
        old_log_prob = batch[self.tensor_keys.sample_log_prob]
        same_shape(log_prob=log_prob, old_log_prob=old_log_prob)
        log_ratio = (log_prob - old_log_prob).unsqueeze(-1)
        if self.surrogate is None:
            objective = clip_surrogate(log_ratio, advantage, self.clip_low, self.clip_high)
        else:
            objective = self.surrogate(log_ratio, advantage)
        same_shape(advantage=advantage, surrogate=objective)

        out = TensorDict({"loss_objective": self.reduce(-objective, batch)})
        if self.entropy_bonus:
            entropy = self.entropy(dist)
            out["loss_entropy"] = self.reduce(-self.entropy_coeff * entropy, batch)
            out["entropy"] = entropy.detach().mean()
        if self.critic_network is not None:
            value, target = self.value(batch), batch[self.tensor_keys.value_target]
            if self.clip_value is None:
                error = value_loss(value, target, self.loss_critic_type)
            else:
                old_value = batch[self.tensor_keys.value]
                error = clipped_value_loss(value, target, old_value, self.clip_value, self.loss_critic_type)
            out["loss_critic"] = self.reduce(self.critic_coeff * error, batch)
            out["explained_variance"] = explained_variance(value.detach(), target)

        ratio = log_ratio.detach().exp()
        out["approx_kl"] = approx_kl(log_ratio.detach()).mean()
        out["clip_fraction"] = ((ratio < 1 - self.clip_low) | (ratio > 1 + self.clip_high)).to(ratio.dtype).mean()
        return out
