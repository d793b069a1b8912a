"""Truncated quantile critics (Kuznetsov et al., 2020, https://arxiv.org/abs/2005.04269)."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from typing_extensions import Unpack

from pgkit.heads import Quantiles
from pgkit.losses.q_base import Critics, head_of
from pgkit.losses.soft_base import SoftQLoss, SoftSettings


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
        top_quantiles_to_drop_per_net: :math:`d`, for critics without a head; a head brings its own.
        settings: those of :class:`~pgkit.losses.SoftQLoss`; ``num_qvalue_nets`` is N, 5 by default, where
            ``qvalue_network`` is one module, and ``actor_value`` is ``mean``.

    Writes what ``SACLoss`` writes.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: Critics,
        *,
        top_quantiles_to_drop_per_net: int = 2,
        **settings: Unpack[SoftSettings],
    ) -> None:
        head = head_of(qvalue_network) or Quantiles(drop=top_quantiles_to_drop_per_net)
        own = SoftSettings(num_qvalue_nets=5, head=head, actor_value="mean")
        super().__init__(actor_network, qvalue_network, **(own | settings))
