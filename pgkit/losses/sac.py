"""Soft actor-critic (Haarnoja et al., 2018, https://arxiv.org/abs/1812.05905)."""

from __future__ import annotations

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
