"""Soft actor-critic (Haarnoja et al., 2018, https://arxiv.org/abs/1812.05905)."""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec

from pgkit.errors import UserError
from pgkit.functional import same_shape, soft_value, temperature_loss, twin_minimum, value_loss
from pgkit.losses.q_base import QLoss


class SACLoss(QLoss):
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

    Args:
        actor_network: probabilistic actor over continuous actions, e.g. :func:`pgkit.modules.tanh_normal_actor`.
        qvalue_network: :func:`pgkit.modules.q_value`, or what :class:`~pgkit.losses.q_base.QLoss` takes besides.
        temperature: block that replaces the four settings of the temperature that follow, e.g.
            :class:`pgkit.controllers.Temperature`.
        alpha_init: temperature at the start.
        min_alpha, max_alpha: its bounds; None: none.
        fixed_alpha: do not train it.
        target_entropy: :math:`\bar H`; ``auto`` is minus the number of action dimensions.
        action_spec: spec of one action; names the dimensions before the first batch does.
        loss_function: ``l2``, ``l1`` or ``smooth_l1``.
        num_qvalue_nets, gamma, delay_actor, delay_qvalue, separate_losses, reduction: as in ``QLoss``.

    Writes ``loss_actor``, ``loss_qvalue``, ``loss_alpha`` and the metrics ``alpha``, ``entropy``, ``q_value``; and
    ``td_error [*B]`` into the batch, the priority of a prioritized replay.

    Raises:
        UserError: the actor is discrete.
    """

    log_alpha: Tensor
    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset({"gamma", "log_alpha"})

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        temperature: nn.Module | None = None,
        alpha_init: float = 1.0,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        fixed_alpha: bool = False,
        target_entropy: str | float = "auto",
        action_spec: TensorSpec | None = None,
        loss_function: str = "l2",
        num_qvalue_nets: int = 2,
        gamma: float = 0.99,
        delay_actor: bool = False,
        delay_qvalue: bool = True,
        separate_losses: bool = False,
        reduction: str | None = None,
    ) -> None:
        _refuse_discrete(actor_network)
        super().__init__(
            actor_network, qvalue_network, num_qvalue_nets=num_qvalue_nets, gamma=gamma, delay_actor=delay_actor,
            delay_qvalue=delay_qvalue, separate_losses=separate_losses, reduction=reduction,
        )  # fmt: skip
        self.temperature: Any = temperature
        if temperature is None:
            log_alpha = torch.tensor(log(alpha_init))
            if fixed_alpha:
                self.register_buffer("log_alpha", log_alpha)
            else:
                self.log_alpha = nn.Parameter(log_alpha)
        self._log_bounds = (log(min_alpha) if min_alpha else None, log(max_alpha) if max_alpha else None)
        self.fixed_alpha, self.loss_function = fixed_alpha, loss_function
        self._target_entropy = None if target_entropy == "auto" else float(target_entropy)
        if self._target_entropy is None and action_spec is not None:
            self._target_entropy = -float(action_spec.shape[-1:].numel())

    @property
    def alpha(self) -> Tensor:
        r"""The temperature :math:`\alpha`, a detached scalar."""
        if self.temperature is not None:
            return self.temperature.alpha
        with torch.no_grad():
            bounded = self._log_bounds != (None, None)
            return (self.log_alpha.clamp_(*self._log_bounds) if bounded else self.log_alpha).exp()

    @property
    def target_entropy(self) -> float:
        r""":math:`\bar H`; with ``auto`` and no ``action_spec``, known after the first batch."""
        if self.temperature is not None:
            return self.temperature.target_entropy
        if self._target_entropy is None:
            raise AttributeError("target_entropy='auto' is read off the first batch of actions: none was seen yet")
        return self._target_entropy

    @property
    def out_keys(self) -> list[NestedKey]:
        """Entries of the result."""
        if self._out_keys is None:
            self._out_keys = ["loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "q_value"]
        return self._out_keys  # pyright: ignore[reportReturnType]

    @out_keys.setter
    def out_keys(self, keys: list[NestedKey]) -> None:
        self._out_keys = keys

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch, alpha = tensordict, self.alpha

        with torch.no_grad():
            next_action, next_log_prob = self.act(batch["next"], self.target_actor_network_params)
            next_q = self.q(batch["next"], next_action, self.target_qvalue_network_params)
            target = self.target(batch, soft_value(next_q, next_log_prob, alpha))

        q = self.q(batch, batch[self.tensor_keys.action], self.qvalue_network_params)
        target = target.unsqueeze(-1).expand_as(q)
        qvalue_loss = value_loss(q, target, self.loss_function).sum(-1) * self.weight(batch)
        self.write_priority(batch, q - target)

        action, log_prob = self.act(batch, self.actor_network_params)
        value = twin_minimum(self.q(batch, action, self.qvalue_network_params.detach()))
        same_shape(log_prob=log_prob, value=value)
        actor_loss = alpha * log_prob - value

        out = TensorDict(
            {
                "loss_actor": self._reduce_loss(actor_loss, batch),
                "loss_qvalue": self._reduce_loss(qvalue_loss, batch),
                "loss_alpha": self._reduce_loss(self._temperature_loss(action, log_prob.detach()), batch),
            }
        )
        out["alpha"], out["entropy"], out["q_value"] = alpha, -log_prob.detach().mean(), q.detach().mean()
        return out

    def _temperature_loss(self, action: Tensor, log_prob: Tensor) -> Tensor:
        if self.temperature is not None:
            return self.temperature.loss(log_prob)
        if self._target_entropy is None:
            self._target_entropy = -action.numel() / log_prob.numel()
        return temperature_loss(self.log_alpha, log_prob, self._target_entropy)


def _refuse_discrete(actor: TensorDictModule) -> None:
    for module in actor.modules():
        kind = getattr(module, "distribution_class", None)
        if kind is not None and not getattr(kind, "has_rsample", True):
            raise UserError(
                f"SACLoss needs an actor over continuous actions, this one is {kind.__name__}: use "
                "modules.tanh_normal_actor, or for discrete actions modules.categorical_actor with losses.ClipPPOLoss "
                "or TorchRL's DiscreteSACLoss"
            )
