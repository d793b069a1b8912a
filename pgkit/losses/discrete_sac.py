"""Soft actor-critic for discrete actions (Christodoulou, 2019, https://arxiv.org/abs/1910.07207)."""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from typing_extensions import Unpack

from pgkit.errors import UserError
from pgkit.functional import expected_soft_value, straight_through_sample, twin_minimum
from pgkit.heads import Returns, Scalar
from pgkit.losses.q_base import Critics, Members
from pgkit.losses.soft_base import SoftQLoss, SoftSettings


class DiscreteSACLoss(SoftQLoss):
    r"""SAC over discrete actions with twin critics and automatic temperature, a drop-in for TorchRL's loss.

    .. math::
        V(s) &= \sum_a w_a(s) \big(\min_i Q_i(s, a) - \alpha \log \pi(a|s)\big) \\
        y &= r + \gamma (1 - \text{terminated}) V'(s') \\
        L_Q &= \frac1B \sum \sum_i (Q_i(s, a) - y)^2 \\
        L_\pi &= -\frac1B \sum V(s) \\
        L_\alpha &= -\frac1B \sum \log\alpha \, \Big(\sum_a w_a \log \pi(a|s) + \bar H\Big)

    ``form="expectation"``: :math:`w = \pi(\cdot|s)`, no sampling noise. ``form="gumbel_softmax"``: :math:`w` is one
    action drawn from the policy, one-hot, with the gradient of its Gumbel-Softmax relaxation (Jang et al., 2017,
    https://arxiv.org/abs/1611.01144).

    Four things differ from TorchRL's loss. The critics' loss is the squared error (there ``smooth_l1``). ``gamma`` is
    given here. Without ``num_actions`` the batch gives the number of actions. The importance weights of a prioritized
    replay apply to the critics alone.

    Args:
        actor_network: actor over discrete actions, e.g. :func:`pgkit.modules.categorical_actor`.
        qvalue_network: an ensemble, ``action_value [*B, critics, actions]`` with an attribute ``num_critics``
            (:func:`pgkit.modules.discrete_q_value`); or as in :class:`~pgkit.losses.QLoss`, ``[*B, actions]`` each.
        action_space: not needed: whether actions are indices or one-hot is read off their shape.
        num_actions: number of actions.
        target_entropy_weight: with ``target_entropy="auto"``, :math:`\bar H` is this times the largest entropy,
            :math:`\log(\text{actions})`.
        target_entropy: :math:`\bar H`, or ``auto``. Where the actor reads an ``action_mask``, that of a state is
            :math:`\bar H \log(\text{allowed}) / \log(\text{actions})`.
        form: ``expectation`` or ``gumbel_softmax``.
        relaxation: temperature of the relaxation, for ``gumbel_softmax``.
        settings: those of :class:`~pgkit.losses.SoftQLoss`.

    Writes what :class:`~pgkit.losses.SACLoss` writes.
    """

    takes_discrete = True

    @dataclass
    class _AcceptedKeys(SoftQLoss._AcceptedKeys):
        """Keys that :meth:`set_keys` can change."""

        action_value: NestedKey = "action_value"

    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: Critics,
        *,
        action_space: str | TensorSpec | None = None,
        num_actions: int | None = None,
        target_entropy_weight: float = 0.98,
        form: Literal["expectation", "gumbel_softmax"] = "expectation",
        relaxation: float = 1.0,
        **settings: Unpack[SoftSettings],
    ) -> None:
        self.num_actions, self.target_entropy_weight = num_actions, target_entropy_weight
        super().__init__(actor_network, qvalue_network, **settings)
        if not isinstance(self.head, Scalar):
            raise UserError(f"DiscreteSACLoss learns expected values: it has no use for head={self.head}")
        if form not in ("expectation", "gumbel_softmax"):
            raise ValueError(f"form is 'expectation' or 'gumbel_softmax', not {form!r}")
        self.form, self.relaxation = form, relaxation

    def automatic_entropy(self, spec: Any) -> float | None:
        """The target entropy that ``auto`` means: a share of the largest; None if the number of actions is unknown."""
        actions = self.num_actions or (None if spec is None else spec.space.n)
        return None if actions is None else self.target_entropy_weight * log(actions)

    def seen_entropy(self, action: Any, log_prob: Tensor) -> float:
        """The same, read off the weights of the actions ``[*B, actions]``."""
        return self.target_entropy_weight * log(action.shape[-1])

    def policy(self, batch: TensorDictBase, params: Any) -> tuple[Tensor, Tensor]:
        """Weights ``w`` and log-probabilities of all actions at the batch's observations, ``[*B, actions]`` each."""
        with params.to_module(self.actor_network, preserve_module_state=False):
            logits = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys)).logits
        log_prob = logits.log_softmax(-1).clamp_min(-1e6)  # 0 log 0 = 0, whatever the temperature
        if self.form == "expectation":
            return log_prob.exp(), log_prob
        return straight_through_sample(log_prob, self.relaxation), log_prob

    def action_values(self, batch: TensorDictBase, params: Any, members: Members = None) -> Tensor:
        """The values ``[*B, critics, actions]`` at the batch's observations, of the critics ``members`` or of all."""
        data = batch.select(*self.qvalue_network.in_keys)
        return self.evaluate(data, self.tensor_keys.action_value, params, members)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch, alpha = tensordict, self.alpha

        with torch.no_grad():
            weights, log_prob = self.policy(batch["next"], self.target_actor_network_params)
            next_q = self.action_values(batch["next"], self.target_qvalue_network_params, self.draw())
            next_value = expected_soft_value(weights, log_prob, twin_minimum(next_q.mT), alpha)
            target = self.target(batch, Returns.certain(next_value))

        q_all = self.action_values(batch, self.qvalue_network_params)
        chosen = _chosen(q_all, batch[self.tensor_keys.action])
        loss_qvalue, q = self.regress(batch, chosen.unsqueeze(-1), target)

        batch, q_all = self.first(batch), self.first(q_all.detach())
        weights, log_prob = self.policy(batch, self.actor_network_params)
        value = expected_soft_value(weights, log_prob, self.actor_value(q_all.mT), alpha)
        loss_actor, expected = self.reduce(-value, batch), (weights * log_prob).sum(-1)
        return self.result(batch, loss_actor, loss_qvalue, weights, expected, q, self.out_of_reach(log_prob))

    def out_of_reach(self, log_prob: Tensor) -> Tensor | float:
        """What an action mask takes off the target entropy, ``[*B]``; ``log_prob [*B, actions]``."""
        known = getattr(self.temperature, "target_entropy", None)
        target = self.seen_entropy(log_prob, log_prob) if self._automatic else known
        if target is None or "action_mask" not in self.actor_network.in_keys:
            return 0.0
        allowed = (log_prob.detach() > -1e5).sum(-1)
        return target * (1 - allowed.log() / log(log_prob.shape[-1]))


def _chosen(q: Tensor, action: Tensor) -> Tensor:
    """Of ``q [*B, critics, actions]`` the action's, ``[*B, critics]``; the action is an index ``[*B]`` or one-hot."""
    if action.dim() == q.dim() - 1 and action.shape[-1] != q.shape[-1]:  # indices [*B, 1]
        action = action.squeeze(-1)
    if action.dim() == q.dim() - 2:
        index = action.reshape(*action.shape, 1, 1).expand(*q.shape[:-1], 1)
        return q.gather(-1, index).squeeze(-1)
    return (q * action.unsqueeze(-2)).sum(-1)
