"""Deep deterministic policy gradient (Lillicrap et al., 2016, https://arxiv.org/abs/1509.02971)."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from typing_extensions import Unpack

from pgkit.errors import UserError
from pgkit.losses.actors import refuse_stochastic
from pgkit.losses.q_base import QLoss, QSettings


class DDPGLoss(QLoss):
    r"""DDPG: one critic and a deterministic actor that climbs it, a drop-in for TorchRL's loss of that name.

    .. math::
        y &= r + \gamma (1 - \text{terminated}) Q'(s', \mu'(s')) \\
        L_Q &= \frac1B \sum (Q(s, a) - y)^2 \\
        L_\pi &= -\frac1B \sum Q(s, \mu(s))

    The equations are those of a scalar critic. One with another head (:mod:`pgkit.heads`) learns by the head's loss.

    Defaults that differ from TorchRL's: the target's action is the delayed actor's, as in the paper (there
    ``delay_actor=False``), ``gamma`` is given here, the importance weights of a prioritized replay apply to the critic
    alone.

    Args:
        actor_network: deterministic actor, e.g. :func:`pgkit.modules.deterministic_actor`.
        value_network: one critic, ``state_action_value [*B, 1]``, e.g. ``pgkit.modules.q_value(env, num_critics=1)``.
        loss_function: distance of a scalar critic: ``l2``, ``l1`` or ``smooth_l1``.
        delay_actor, delay_value: use a delayed actor, a delayed critic in the target.
        settings: ``gamma``, ``separate_losses``, ``augmented``, ``reduction`` and ``head`` of
            :class:`~pgkit.losses.QLoss`.

    Writes ``loss_actor``, ``loss_value`` and, as numbers, the metrics ``pred_value``, ``target_value`` (means),
    ``pred_value_max``, ``target_value_max``; and ``td_error [*B]`` into the batch, a prioritized replay's priority.

    Raises:
        UserError: the actor draws its actions from a distribution, or there are several critics.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        loss_function: str = "l2",
        delay_actor: bool = True,
        delay_value: bool = True,
        **settings: Unpack[QSettings],  # pyright: ignore[reportGeneralTypeIssues]
    ) -> None:
        super().__init__(
            actor_network,
            value_network,
            num_qvalue_nets=1,
            delay_actor=delay_actor,
            delay_qvalue=delay_value,
            **settings,
        )
        refuse_stochastic("DDPGLoss", actor_network)
        if self.num_critics != 1:
            raise UserError(
                f"DDPGLoss has one critic, these are {self.num_critics}: num_critics=1, or losses.TD3Loss for two"
            )
        self.delay_value = delay_value
        self.set_distance(loss_function)

    @property
    def value_network_params(self) -> Any:
        """TorchRL's name of the critic's parameters."""
        return self.qvalue_network_params

    @property
    def target_value_network_params(self) -> Any:
        """TorchRL's name of the delayed critic's parameters."""
        return self.target_qvalue_network_params

    def _writes(self) -> list[NestedKey]:
        return ["loss_actor", "loss_value", "pred_value", "target_value", "pred_value_max", "target_value_max"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch = tensordict

        with torch.no_grad():
            next_action = self.action(batch["next"], self.target_actor_network_params)
            next_outputs = self.outputs(batch["next"], next_action, self.target_qvalue_network_params)
            target = self.target(batch, self.head.returns(next_outputs.squeeze(-2)))

        outputs = self.outputs(batch, batch[self.tensor_keys.action], self.qvalue_network_params)
        loss_value, q = self.regress(batch, outputs, target)
        y = self.average(target.mean, batch)

        batch = self.first(batch)
        action = self.action(batch, self.actor_network_params)
        value = self.q(batch, action, self.qvalue_network_params.detach()).squeeze(-1)

        out = TensorDict({"loss_actor": self.reduce(-value, batch), "loss_value": loss_value})
        out["pred_value"], out["pred_value_max"] = q, self.head.mean(outputs).detach().max()
        out["target_value"], out["target_value_max"] = y, target.mean.max()
        return out
