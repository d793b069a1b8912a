"""Twin delayed deep deterministic policy gradient (Fujimoto et al., 2018, https://arxiv.org/abs/1802.09477)."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from typing_extensions import Unpack

from pgkit.errors import UserError
from pgkit.functional import smoothed_action
from pgkit.losses.actors import action_spec_of, refuse_stochastic
from pgkit.losses.q_base import Critics, QLoss, QSettings


class TD3Loss(QLoss):
    r"""TD3: twin critics whose targets are smoothed over actions, a drop-in for TorchRL's loss of that name.

    .. math::
        a' &= \text{clip}\big(\mu'(s') + \text{clip}(\sigma \epsilon, \pm c), a_{low}, a_{high}\big),
              \quad \epsilon \sim N(0, 1) \\
        y &= r + \gamma (1 - \text{terminated}) \min_i Q'_i(s', a') \\
        L_Q &= \frac1B \sum \sum_i (Q_i(s, a) - y)^2 \\
        L_\pi &= -\frac1B \sum Q_1(s, \mu(s))

    The equations are those of scalar critics. Critics with another head (:mod:`pgkit.heads`) pool their distributions
    in place of the minimum, and learn by the head's own loss.

    The third part of TD3, the delay, is the update's: ``OffPolicyUpdate(actor_delay=2, delay_targets=True)``. Defaults
    that differ from TorchRL's: the critics' loss is the squared error (there ``smooth_l1``), ``gamma`` is given here,
    the importance weights of a prioritized replay apply to the critics alone.

    Args:
        actor_network: deterministic actor, e.g. :func:`pgkit.modules.deterministic_actor`.
        qvalue_network: critics, as in :class:`~pgkit.losses.QLoss`.
        action_spec: bounded spec of one action, or of the actions ``[num_envs, actions]`` of a vector.
        bounds: ``(low, high)`` in its place.
        policy_noise: :math:`\sigma`, in the unit of the action; a number, or a tensor ``[actions]``.
        noise_clip: :math:`c`, likewise.
        loss_function: distance of scalar critics: ``l2``, ``l1`` or ``smooth_l1``.
        settings: those of ``QLoss``; ``delay_actor`` is True by default.

    Writes ``loss_actor``, ``loss_qvalue`` and, as means, the metrics ``pred_value``, ``state_action_value_actor``,
    ``next_state_value``, ``target_value``; and ``td_error [*B]`` into the batch, the priority of a prioritized replay.

    Raises:
        UserError: the actor draws its actions from a distribution, it is not exactly one of ``action_spec`` and
            ``bounds`` that is given, or the spec has no bounds.
    """

    min_action: Tensor
    max_action: Tensor
    policy_noise: Tensor
    noise_clip: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: Critics,
        *,
        action_spec: TensorSpec | None = None,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        policy_noise: float | Tensor = 0.2,
        noise_clip: float | Tensor = 0.5,
        loss_function: str = "l2",
        **settings: Unpack[QSettings],
    ) -> None:
        if (action_spec is None) == (bounds is None):
            raise UserError("TD3Loss clips its smoothed actions: give it action_spec= or bounds=, one of the two")
        super().__init__(actor_network, qvalue_network, **(QSettings(delay_actor=True) | settings))
        refuse_stochastic("TD3Loss", actor_network)
        self.set_distance(loss_function)
        low, high = bounds or _bounds(action_spec_of(actor_network, self.tensor_keys.action, action_spec))
        numbers = {"min_action": low, "max_action": high, "policy_noise": policy_noise, "noise_clip": noise_clip}
        for name, number in numbers.items():
            exact = number if isinstance(number, Tensor) else torch.tensor(number, dtype=torch.float64)
            self.register_buffer(name, exact)

    def _writes(self) -> list[NestedKey]:
        metrics = ["pred_value", "state_action_value_actor", "next_state_value", "target_value"]
        return ["loss_actor", "loss_qvalue", *metrics]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch = tensordict

        with torch.no_grad():
            next_action = smoothed_action(
                self.action(batch["next"], self.target_actor_network_params),
                self.policy_noise, self.noise_clip, self.min_action, self.max_action,
            )  # fmt: skip
            min_q = self.min_q(batch["next"], next_action, self.target_qvalue_network_params)
            target = self.target(batch, min_q)

        outputs = self.outputs(batch, batch[self.tensor_keys.action], self.qvalue_network_params)
        loss_qvalue, q = self.regress(batch, outputs, target)

        means = [self.average(x.mean, batch) for x in (min_q, target)]
        batch = self.first(batch)
        action = self.action(batch, self.actor_network_params)
        q1 = self.q(batch, action, self.qvalue_network_params.detach(), slice(1)).squeeze(-1)

        out = TensorDict({"loss_actor": self.reduce(-q1, batch), "loss_qvalue": loss_qvalue})
        out["pred_value"], out["state_action_value_actor"] = q, self.average(q1, batch)
        out["next_state_value"], out["target_value"] = means
        return out


def _bounds(spec: Any) -> tuple[Tensor, Tensor]:
    """Least and largest action ``[actions]``, of a vector's spec those of its first environment."""
    if not isinstance(spec, Bounded):
        raise UserError(f"TD3Loss clips its smoothed actions: their spec must be Bounded, this one is {spec}")
    space: Any = spec.space
    low, high = (x[(0,) * (x.dim() - 1)] for x in (space.low, space.high))
    return low, high
