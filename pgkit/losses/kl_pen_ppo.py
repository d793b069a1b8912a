"""PPO with an adaptive KL penalty (Schulman et al., 2017, https://arxiv.org/abs/1707.06347, section 4)."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from typing_extensions import Unpack

from pgkit.functional import adapted_coefficient, approx_kl, ratio_surrogate
from pgkit.losses.policy_base import PolicyLoss, PolicySettings


class KLPENPPOLoss(PolicyLoss):
    r"""PPO with a KL penalty, a drop-in for TorchRL's loss of that name.

    .. math::
        L = -\frac1B \sum \big(r A - \beta\, KL(\pi_{old} \| \pi)\big)
            + c_V \frac1B \sum (V - V^{target})^2 - c_H \frac1B \sum H[\pi]

    The batch holds the parameters of :math:`\pi_{old}` (``loc`` and ``scale``, or ``logits``): TorchRL's collectors
    write them, with pgkit's call ``loss.keep_distribution(rollout)`` first. The KL is in closed form where the
    distributions have one.

    With a ``controller``, :math:`\beta` is its to set, e.g. once a rollout as in the paper. Without one this loss
    adapts :math:`\beta` in every call, as TorchRL's does. Defaults that differ from TorchRL's: squared error for the
    value (there ``smooth_l1``), the advantage normalized in every minibatch (there it is not), entropy coefficient 0.

    Args:
        actor_network: probabilistic actor.
        critic_network: value operator; None leaves the value loss out.
        controller: holds ``beta``, a scalar tensor, e.g. :class:`pgkit.controllers.AdaptiveKL`; replaces the four
            settings that follow.
        dtarg: KL that :math:`\beta` aims at.
        beta: :math:`\beta` at the start.
        increment: factor of :math:`\beta` when the KL is above 1.5 times ``dtarg``.
        decrement: factor of :math:`\beta` when the KL is below ``dtarg`` / 1.5.
        settings: those of :class:`~pgkit.losses.PolicyLoss`; ``normalize_advantage`` is True by default.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and the metrics ``entropy``, ``kl``, ``kl_approx``
    (the estimate from the batch's actions), ``beta``, ``explained_variance``.
    """

    _schedulable_buffers: ClassVar[frozenset[str]] = PolicyLoss._schedulable_buffers | {"beta"}

    beta: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule | None = None,
        *,
        controller: nn.Module | None = None,
        dtarg: float = 0.01,
        beta: float = 1.0,
        increment: float = 2.0,
        decrement: float = 0.5,
        **settings: Unpack[PolicySettings],
    ) -> None:
        super().__init__(actor_network, critic_network, **(PolicySettings(normalize_advantage=True) | settings))
        self.controller = controller
        self.dtarg, self.increment, self.decrement = dtarg, increment, decrement
        if controller is None:
            self.register_coeff_buffer("beta", beta, dtype=torch.float32)  # a compiled step loses writes to a float64

    def _read_keys(self) -> list[NestedKey]:
        return [*super()._read_keys(), *self.distribution_keys]

    def _writes(self) -> list[NestedKey]:
        return [*super()._writes(), "kl", "kl_approx", "beta"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` with ``advantage`` ``[*B, 1]`` and the old distribution."""
        batch = tensordict.copy()
        advantage, dist = self.get_advantage(batch), self.distribution(batch)
        kl = self.kl(batch, dist).unsqueeze(-1)
        beta = (self.beta if self.controller is None else self.controller.beta).clone()
        log_ratio = self.log_ratio(dist, batch)
        objective = ratio_surrogate(log_ratio, advantage) - beta * kl

        out = self.result(batch, objective, dist)
        out["kl"], out["beta"] = self.average(kl, batch), beta
        out["kl_approx"] = self.average(approx_kl(log_ratio), batch)
        if self.controller is None:
            with torch.no_grad():
                self.beta.copy_(adapted_coefficient(beta, out["kl"], self.dtarg, self.increment, self.decrement))
        return out
