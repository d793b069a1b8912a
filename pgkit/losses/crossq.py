"""CrossQ (Bhatt et al., 2024, https://arxiv.org/abs/1902.05605)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch import nn
from typing_extensions import Unpack

from pgkit.functional import same_shape
from pgkit.losses.q_base import Critics
from pgkit.losses.soft_base import SoftQLoss, SoftSettings


class CrossQLoss(SoftQLoss):
    r"""CrossQ: no target network; batch normalization sees both action distributions in one joint forward pass.

    .. math::
        \begin{bmatrix} Q_i(s, a) \\ Q_i(s', a') \end{bmatrix} &=
            Q_i\Big(\begin{bmatrix} s, a \\ s', a' \end{bmatrix}\Big), \quad a' \sim \pi(\cdot|s') \\
        y &= r + \gamma (1 - \text{terminated}) \big(\min_i Q_i(s', a') - \alpha \log \pi(a'|s')\big)
             \quad \text{(no gradient)} \\
        L_Q &= \frac1B \sum \sum_i (Q_i(s, a) - y)^2 \\
        L_\pi &= \frac1B \sum \alpha \log \pi(\tilde a|s) - \min_i Q_i(s, \tilde a)

    With ``delay_qvalue=True`` the joint pass serves the normalization alone, and :math:`y` comes from delayed critics,
    which use their running statistics (FlashSAC, 2026, https://arxiv.org/abs/2604.04539).

    The critics want batch normalization: ``modules.q_value(env, body=modules.batch_renorm_mlp)``, or torch's or
    TorchRL's layers. In :math:`L_\pi` it uses its running statistics.

    A drop-in for TorchRL's loss of that name; there the distance is ``smooth_l1``.

    Args:
        actor_network: as in :class:`~pgkit.losses.SACLoss`.
        qvalue_network: likewise.
        settings: the other settings of :class:`~pgkit.losses.SoftQLoss`, but ``delay_actor``; ``delay_qvalue`` is
            off by default.

    Writes what ``SACLoss`` writes.
    """

    def __init__(
        self, actor_network: TensorDictModule, qvalue_network: Critics, **settings: Unpack[SoftSettings]
    ) -> None:
        settings.setdefault("delay_qvalue", False)
        super().__init__(actor_network, qvalue_network, delay_actor=False, **settings)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch, alpha = tensordict, self.alpha

        with torch.no_grad():
            next_action, next_log_prob = self.act(batch["next"], self.actor_network_params)
        keys = [key for key in self.qvalue_network.in_keys if key != self.tensor_keys.action]
        both = torch.cat([batch.select(*keys), batch["next"].select(*keys)])
        both_actions = torch.cat([batch[self.tensor_keys.action], next_action])
        outputs, next_outputs = self.outputs(both, both_actions, self.qvalue_network_params).chunk(2)

        with torch.no_grad():
            members = self.draw()
            if self.delay_qvalue:
                next_outputs = self.outputs(batch["next"], next_action, self.target_qvalue_network_params)
            min_q = self.head.least(next_outputs if members is None else next_outputs[..., members, :])
            target = self.target(batch, min_q - alpha * next_log_prob)
        loss_qvalue, q = self.regress(batch, outputs, target)

        batch = self.first(batch)
        action, log_prob = self.act(batch, self.actor_network_params)
        with _running_statistics(self.qvalue_network):
            value = self.actor_value(self.q(batch, action, self.qvalue_network_params.detach()))
        same_shape(log_prob=log_prob, value=value)
        loss_actor = self.reduce(alpha * log_prob - value, batch)
        return self.result(batch, loss_actor, loss_qvalue, action, log_prob, q)


@contextmanager
def _running_statistics(network: nn.Module) -> Iterator[None]:
    """Normalization layers that go by a mode (torch's, TorchRL's) use their running statistics and leave them."""
    switched = [module for module in network.modules() if module.training and hasattr(module, "running_mean")]
    for module in switched:
        module.training = False
    try:
        yield
    finally:
        for module in switched:
            module.training = True
