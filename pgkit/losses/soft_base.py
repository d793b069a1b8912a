"""What the entropy-regularized off-policy losses share: the temperature and TorchRL's settings for it."""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from pgkit.errors import UserError
from pgkit.functional import ensemble_mean, random_subset, temperature_loss, twin_minimum
from pgkit.heads import Head
from pgkit.losses.q_base import QLoss


class SoftQLoss(QLoss):
    r"""Base of SAC and its descendants: a :class:`~pgkit.losses.QLoss` with a temperature :math:`\alpha`.

    Args:
        actor_network: probabilistic actor.
        qvalue_network: :func:`pgkit.modules.q_value`, or what ``QLoss`` takes besides.
        temperature: block that replaces the five settings that follow, e.g. :class:`pgkit.controllers.Temperature`.
        alpha_init: temperature at the start.
        min_alpha, max_alpha: its bounds; None: none.
        fixed_alpha: do not train it.
        target_entropy: :math:`\bar H`; ``auto`` is minus the number of action dimensions.
        action_spec: spec of one action; names the dimensions before the first batch does.
        loss_function: distance of scalar critics: ``l2``, ``l1`` or ``smooth_l1``.
        subset: so many critics, drawn anew at every call, make the target (REDQ's M); None: all.
        actor_value: the actor maximizes the ``min`` or the ``mean`` of the critics.
        num_qvalue_nets, gamma, delay_actor, delay_qvalue, separate_losses, reduction, head: as in ``QLoss``.

    Raises:
        UserError: the actor is discrete and the loss is not, or the other way round (``takes_discrete``); ``subset`` is
            above the number of critics; ``loss_function`` is given for critics whose head has its own.
    """

    takes_discrete: ClassVar[bool] = False
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
        subset: int | None = None,
        actor_value: str = "min",
        num_qvalue_nets: int = 2,
        gamma: float = 0.99,
        delay_actor: bool = False,
        delay_qvalue: bool = True,
        separate_losses: bool = False,
        reduction: str | None = None,
        head: Head | None = None,
    ) -> None:
        _check_actions(type(self).__name__, actor_network, self.takes_discrete)
        super().__init__(
            actor_network, qvalue_network, num_qvalue_nets=num_qvalue_nets, gamma=gamma, delay_actor=delay_actor,
            delay_qvalue=delay_qvalue, separate_losses=separate_losses, reduction=reduction, head=head,
        )  # fmt: skip
        if temperature is not None and not (hasattr(temperature, "alpha") and hasattr(temperature, "loss")):
            raise UserError(
                f"temperature={temperature!r}: give a block with alpha and loss (controllers.Temperature, "
                "controllers.FixedTemperature(0.2))"
            )
        if temperature is not None and not (isinstance(temperature.alpha, Tensor) and temperature.alpha.numel() == 1):
            raise UserError(
                f"{type(temperature).__name__}.alpha is {temperature.alpha!r}: make it a tensor of one number"
            )
        self.set_distance(loss_function)
        if subset is not None and not 1 <= subset <= self.num_critics:
            raise UserError(f"subset={subset} of {self.num_critics} critics: give a number from 1 to the latter")
        values = {"min": twin_minimum, "mean": ensemble_mean}
        if actor_value not in values:
            raise UserError(f"actor_value={actor_value!r}: give 'min' or 'mean'")
        if alpha_init <= 0:
            raise UserError(f"alpha_init={alpha_init:g}: give a number above 0")
        self.subset, self.actor_value = subset, values[actor_value]
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
        if isinstance(action_spec, Composite):
            action_spec = action_spec[self.tensor_keys.action]
        if self._target_entropy is None and action_spec is not None:
            self._target_entropy = -float(action_spec.shape[-1:].numel())

    @property
    def alpha(self) -> Tensor:
        r"""The temperature :math:`\alpha`, a detached scalar."""
        if self.temperature is not None:
            return self.temperature.alpha.detach().clone()  # a controller may move it while the loss is computed
        with torch.no_grad():
            bounded = self._log_bounds != (None, None)
            return (self.log_alpha.clamp_(*self._log_bounds) if bounded else self.log_alpha).exp()

    @property
    def target_entropy(self) -> float:
        r""":math:`\bar H`; with ``auto`` and no ``action_spec``, known after the first batch."""
        if self.temperature is not None:
            target = getattr(self.temperature, "target_entropy", None)
            if target is None:
                raise UserError(f"{type(self.temperature).__name__} has no target_entropy")
            return target
        if self._target_entropy is None:
            raise UserError("target_entropy='auto' is read off the first batch of actions: none was seen yet")
        return self._target_entropy

    def draw(self) -> Tensor | None:
        """The critics that make this call's target, ``[subset]``; None: all."""
        if self.subset is None or self.subset == self.num_critics:  # inductor 2.13 cannot compile x[randperm(n)]
            return None
        return random_subset(self.num_critics, self.subset, self.gamma.device)

    def temperature_loss(self, action: Tensor, log_prob: Tensor) -> Tensor:
        """Unreduced ``[*B]`` loss of the temperature at actions ``[*B, actions]`` drawn now, ``log_prob [*B]``."""
        log_prob = log_prob.detach()
        if self.temperature is not None:
            return self.temperature.loss(log_prob)
        if self._target_entropy is None:
            self._target_entropy = -action.numel() / log_prob.numel()
        return temperature_loss(self.log_alpha, log_prob, self._target_entropy)

    def result(
        self,
        batch: TensorDictBase,
        actor: Tensor,
        qvalue: Tensor,
        action: Tensor,
        log_prob: Tensor,
        q: Tensor,
        out_of_reach: Tensor | float = 0.0,
    ) -> TensorDict:
        """The three losses of the unreduced ``[*B]``, and the metrics; ``log_prob [*B]`` is that of ``action``.

        ``out_of_reach [*B]`` is the part of the target entropy that is not asked of a row.
        """
        out = TensorDict(
            {
                "loss_actor": self.reduce(actor, batch),
                "loss_qvalue": self.reduce(qvalue, batch),
                "loss_alpha": self.reduce(self.temperature_loss(action, log_prob - out_of_reach), batch),
            }
        )
        out["alpha"], out["entropy"], out["q_value"] = self.alpha, -log_prob.detach().mean(), q.detach().mean()
        return out

    def _writes(self) -> list[NestedKey]:
        return ["loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "q_value"]


def _check_actions(loss: str, actor: TensorDictModule, discrete: bool) -> None:
    if hasattr(actor, "in_keys") and not hasattr(actor, "dist_sample_keys"):
        raise UserError(
            f"{loss} needs an actor that draws from a distribution (modules.tanh_normal_actor), this one gives one "
            "action: losses.TD3Loss and losses.DDPGLoss take it"
        )
    for module in actor.modules():
        kind = getattr(module, "distribution_class", None)
        if kind is None:
            continue
        if discrete and not getattr(kind, "has_rsample", True) and not hasattr(kind, "logits"):
            raise UserError(
                f"{loss} takes one discrete action, this actor draws {kind.__name__} ones: losses.ClipPPOLoss and "
                "losses.A2CLoss take it"
            )
        if discrete == (not getattr(kind, "has_rsample", True)):
            continue
        if discrete:
            raise UserError(
                f"{loss} needs an actor over discrete actions, this one is {kind.__name__}: use "
                "modules.categorical_actor, or losses.SACLoss for this actor"
            )
        raise UserError(
            f"{loss} needs an actor over continuous actions, this one is {kind.__name__}: use "
            "modules.tanh_normal_actor, or for discrete actions modules.categorical_actor with "
            "losses.DiscreteSACLoss or losses.ClipPPOLoss"
        )
