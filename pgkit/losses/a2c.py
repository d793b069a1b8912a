"""Advantage actor-critic (Mnih et al., 2016, https://arxiv.org/abs/1602.01783), synchronous."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey

from pgkit.functional import policy_gradient
from pgkit.losses.policy_base import PolicyLoss


class A2CLoss(PolicyLoss):
    r"""A2C, a drop-in for TorchRL's loss of that name.

    .. math::
        L = -\frac1B \sum \log \pi(a|s)\, A + c_V \frac1B \sum (V - V^{target})^2 - c_H \frac1B \sum H[\pi]

    Its gradient is right only for actions of the present policy: one step a rollout. With the advantage of
    :class:`pgkit.advantages.VTrace`, which carries the clipped importance weight, it is IMPALA's loss.
    Defaults that differ from TorchRL's: squared error for the value (there ``smooth_l1``), entropy coefficient 0
    (there 0.01).

    The arguments are those of :class:`~pgkit.losses.PolicyLoss`.

    Writes ``loss_objective``, ``loss_critic``, ``loss_entropy`` and the metrics ``entropy``, ``explained_variance``.
    """

    def _read_keys(self) -> list[NestedKey]:
        return [key for key in super()._read_keys() if key != self.tensor_keys.sample_log_prob]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` with ``advantage`` ``[*B, 1]``."""
        batch = tensordict.copy()
        advantage, dist = self.get_advantage(batch), self.distribution(batch)
        objective = policy_gradient(self.log_prob(dist, batch).unsqueeze(-1), advantage)
        return self.result(batch, objective, dist)
