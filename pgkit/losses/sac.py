"""Soft actor-critic (Haarnoja et al., 2018, https://arxiv.org/abs/1812.05905)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch

from pgkit.functional import same_shape, soft_returns
from pgkit.losses.soft_base import SoftQLoss


class SACLoss(SoftQLoss):
    r"""SAC with twin critics and automatic temperature, a drop-in for TorchRL's loss of that name.

    .. math::
        y &= r + \gamma (1 - \text{terminated}) \big(\min_i Q'_i(s', a') - \alpha \log \pi(a'|s')\big),
             \quad a' \sim \pi(\cdot|s') \\
        L_Q &= \frac1B \sum \sum_i (Q_i(s, a) - y)^2 \\
        L_\pi &= \frac1B \sum \alpha \log \pi(\tilde a|s) - \min_i Q_i(s, \tilde a), \quad \tilde a \sim \pi(\cdot|s) \\
        L_\alpha &= -\frac1B \sum \log\alpha \, (\log \pi(\tilde a|s) + \bar H)

    Each term trains its own parameters only, so that the gradient of their sum is right. Defaults that differ from
    TorchRL's: the critics' loss is the squared error (there ``smooth_l1``), ``gamma`` is given here, the importance
    weights of a prioritized replay apply to the critics alone.

    The equations are those of scalar critics. Critics with another head (:mod:`pgkit.heads`) pool their distributions
    in place of the minimum, and learn by the head's own loss; ``subset`` and ``actor_value`` make it REDQ.

    The arguments are those of :class:`~pgkit.losses.SoftQLoss`; the actor is over continuous actions, e.g.
    :func:`pgkit.modules.tanh_normal_actor`.

    Writes ``loss_actor``, ``loss_qvalue``, ``loss_alpha`` and the metrics ``alpha``, ``entropy``, ``q_value``; and
    ``td_error [*B]`` into the batch, the priority of a prioritized replay.
    """

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch, alpha = tensordict, self.alpha

        with torch.no_grad():
            next_action, next_log_prob = self.act(batch["next"], self.target_actor_network_params)
            next_returns = self.returns(batch["next"], next_action, self.target_qvalue_network_params, self.draw())
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
