"""Randomized ensembled double Q-learning (Chen et al., 2021, https://arxiv.org/abs/2101.05982)."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from typing_extensions import Unpack

from pgkit.losses.q_base import Critics
from pgkit.losses.soft_base import SoftQLoss, SoftSettings


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
        qvalue_network: likewise; a head's ``least`` takes the minimum's place.
        sub_sample_len: M.
        settings: those of :class:`~pgkit.losses.SoftQLoss`; ``num_qvalue_nets`` is N, 10 by default, where
            ``qvalue_network`` is one module, and ``actor_value`` is ``mean``.

    Writes what ``SACLoss`` writes.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: Critics,
        *,
        sub_sample_len: int = 2,
        **settings: Unpack[SoftSettings],
    ) -> None:
        own = SoftSettings(num_qvalue_nets=10, subset=sub_sample_len, actor_value="mean")
        super().__init__(actor_network, qvalue_network, **(own | settings))
