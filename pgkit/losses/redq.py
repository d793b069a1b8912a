"""Randomized ensembled double Q-learning (Chen et al., 2021, https://arxiv.org/abs/2101.05982)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch

from pgkit.functional import same_shape, soft_returns
from pgkit.losses.soft_base import SoftQLoss


class REDQLoss(SoftQLoss):
    r"""REDQ: N critics, a target from M of them drawn for each update, an actor that maximizes the mean of all.

    .. math::
        y &= r + \gamma (1 - \text{terminated}) \big(\min_{i \in \mathcal M} Q'_i(s', a') - \alpha \log \pi(a'|s')\big),
             \quad \mathcal M \subset \{1, \dots, N\} \text{ random}, |\mathcal M| = M \\
        L_Q &= \frac1B \sum \sum_{i=1}^N (Q_i(s, a) - y)^2 \\
        L_\pi &= \frac1B \sum \alpha \log \pi(\tilde a|s) - \frac1N \sum_{i=1}^N Q_i(s, \tilde a)

    The third part of REDQ, 20 critic steps for each frame and one of the actor, is the update's:
    ``OffPolicyUpdate(updates_per_step=20, actor_delay=20)``. Only the M drawn critics are evaluated for the target.

    A drop-in for TorchRL's loss of that name. Different there: ``smooth_l1``, :math:`L_Q` divided by N, the temperature
    within 0.1 and 10 and trained on the next action as well, squared errors as priorities.

    Args:
        actor_network: as in :class:`~pgkit.losses.SACLoss`.
        qvalue_network: likewise; with a head its pool takes the minimum's place.
        num_qvalue_nets: N, where ``qvalue_network`` is one module; an ensemble or a list brings its own.
        sub_sample_len: M.
        settings: the other settings of :class:`~pgkit.losses.SoftQLoss`; its ``actor_value`` is ``mean`` here.

    Writes what ``SACLoss`` writes.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        num_qvalue_nets: int = 10,
        sub_sample_len: int = 2,
        **settings: Any,
    ) -> None:
        settings = {"subset": sub_sample_len, "actor_value": "mean", "num_qvalue_nets": num_qvalue_nets, **settings}
        super().__init__(actor_network, qvalue_network, **settings)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch, alpha = tensordict, self.alpha

        with torch.no_grad():
            subset = self.draw()
            next_action, next_log_prob = self.act(batch["next"], self.target_actor_network_params)
            next_returns = self.returns(batch["next"], next_action, self.target_qvalue_network_params, subset)
            atoms, weights = self.head.pool(next_returns)
            atoms = self.target(batch, soft_returns(atoms, next_log_prob, alpha))

        returns = self.returns(batch, batch[self.tensor_keys.action], self.qvalue_network_params)
        qvalue_loss = self.head.loss(returns, atoms, weights).sum(-1) * self.weight(batch)
        q = self.head.mean(returns)
        self.write_priority(batch, q - (atoms * weights).sum(-1, keepdim=True))

        action, log_prob = self.act(batch, self.actor_network_params)
        value = self.actor_value(self.q(batch, action, self.qvalue_network_params.detach()))
        same_shape(log_prob=log_prob, value=value)
        return self.result(batch, alpha * log_prob - value, qvalue_loss, action, log_prob, q)
