"""Truncated quantile critics (Kuznetsov et al., 2020, https://arxiv.org/abs/2005.04269)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch

from pgkit.functional import same_shape, soft_returns
from pgkit.heads import Head, Quantiles
from pgkit.losses.soft_base import SoftQLoss


class TQCLoss(SoftQLoss):
    r"""TQC: critics of quantiles, a target from all their atoms but the largest, an actor that maximizes the mean.

    .. math::
        y_k &= r + \gamma (1 - \text{terminated}) \big(z_{(k)}(s', a') - \alpha \log \pi(a'|s')\big),
               \quad k = 1, \dots, N (M - d) \\
        L_Q &= \frac1B \sum \sum_{i=1}^N \text{quantile-Huber}\big(\theta_i(s, a), y\big) \\
        L_\pi &= \frac1B \sum \alpha \log \pi(\tilde a|s) - \frac1{NM} \sum_{i, m} \theta_{i,m}(s, \tilde a)

    where :math:`z_{(1)} \le \dots \le z_{(NM)}` are the sorted atoms of all N critics, M each, and the :math:`dN`
    largest are left out.

    A drop-in for TorchRL's loss of that name; there the priority is the mean absolute difference of all pairs of atoms,
    here the difference of the means.

    Args:
        actor_network: as in :class:`~pgkit.losses.SACLoss`.
        qvalue_network: ``modules.q_value(env, 5, head=heads.Quantiles(25, drop=2))``; or a list of modules, or one,
            with ``[*B, M]``.
        num_qvalue_nets: N, where ``qvalue_network`` is one module; an ensemble or a list brings its own.
        top_quantiles_to_drop_per_net: :math:`d`, for critics without a head; a head brings its own.
        settings: the other settings of :class:`~pgkit.losses.SoftQLoss`; its ``actor_value`` is ``mean`` here.

    Writes what ``SACLoss`` writes.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        num_qvalue_nets: int = 5,
        top_quantiles_to_drop_per_net: int = 2,
        **settings: Any,
    ) -> None:
        one = qvalue_network[0] if isinstance(qvalue_network, Sequence) else qvalue_network
        own = getattr(one, "head", None)
        head = own if isinstance(own, Head) else Quantiles(drop=top_quantiles_to_drop_per_net)
        settings = {"actor_value": "mean", "head": head, "num_qvalue_nets": num_qvalue_nets, **settings}
        super().__init__(actor_network, qvalue_network, **settings)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch, alpha = tensordict, self.alpha

        with torch.no_grad():
            next_action, next_log_prob = self.act(batch["next"], self.target_actor_network_params)
            next_quantiles = self.returns(batch["next"], next_action, self.target_qvalue_network_params, self.draw())
            atoms, weights = self.head.pool(next_quantiles)  # [*B, N (M - d)]
            atoms = self.target(batch, soft_returns(atoms, next_log_prob, alpha))

        quantiles = self.returns(batch, batch[self.tensor_keys.action], self.qvalue_network_params)
        qvalue_loss = self.head.loss(quantiles, atoms, weights).sum(-1) * self.weight(batch)
        q = self.head.mean(quantiles)
        self.write_priority(batch, q - (atoms * weights).sum(-1, keepdim=True))

        action, log_prob = self.act(batch, self.actor_network_params)
        value = self.actor_value(self.q(batch, action, self.qvalue_network_params.detach()))
        same_shape(log_prob=log_prob, value=value)
        return self.result(batch, alpha * log_prob - value, qvalue_loss, action, log_prob, q)
