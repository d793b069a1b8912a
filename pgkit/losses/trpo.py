"""Trust-region policy optimization (Schulman et al., 2015, https://arxiv.org/abs/1502.05477)."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import dispatch

from pgkit.functional import ratio_surrogate
from pgkit.losses.policy_base import PolicyLoss


class TRPOLoss(PolicyLoss):
    r"""The surrogate of TRPO and of the natural policy gradient, and the value loss beside it.

    .. math::
        L = -\frac1B \sum r A + c_V \frac1B \sum (V - V^{target})^2 - c_H \frac1B \sum H[\pi],
        \qquad r = \pi(a|s) / \pi_{old}(a|s)

    The constraint on :math:`KL(\pi_{old} \| \pi)` (:meth:`kl`) is the business of
    :class:`pgkit.updates.TrustRegionUpdate`.

    The arguments are those of :class:`~pgkit.losses.PolicyLoss`.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and the metrics ``entropy``, ``explained_variance``.
    """

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` with ``advantage`` ``[*B, 1]``."""
        batch = tensordict.copy()
        advantage, dist = self.get_advantage(batch), self.distribution(batch)
        objective = ratio_surrogate(self.log_ratio(dist, batch), advantage)
        return self.result(batch, objective, dist)
