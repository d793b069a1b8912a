"""What the entropy-regularized off-policy losses share: the temperature, and the forward of SAC, REDQ and TQC."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from typing_extensions import Unpack

from pgkit.controllers import Temperature
from pgkit.errors import UserError
from pgkit.functional import ensemble_mean, random_subset, same_shape, twin_minimum
from pgkit.losses.actors import action_spec_of, dimensions, need_distribution, need_kind
from pgkit.losses.q_base import Critics, QLoss, QSettings

_ACTOR_VALUES = {"min": twin_minimum, "mean": ensemble_mean}


class SoftSettings(QSettings, total=False):
    """Keywords of :class:`SoftQLoss`, which says what they mean and what they default to."""

    temperature: nn.Module | None
    alpha_init: float
    min_alpha: float | None
    max_alpha: float | None
    fixed_alpha: bool
    target_entropy: str | float
    action_spec: TensorSpec | None
    loss_function: str
    subset: int | None
    actor_value: str


class SoftQLoss(QLoss):
    r"""SAC and its descendants: a :class:`~pgkit.losses.QLoss` with a temperature :math:`\alpha`.

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
        settings: those of ``QLoss``.

    Raises:
        UserError: the actor is discrete and the loss is not, or the other way round (``takes_discrete``); ``subset`` is
            above the number of critics; ``loss_function`` is given for critics whose head has its own.
    """

    takes_discrete: ClassVar[bool] = False
    log_alpha: Tensor
    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset({"gamma"})

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: Critics,
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
        **settings: Unpack[QSettings],
    ) -> None:
        super().__init__(actor_network, qvalue_network, **settings)
        need_distribution(type(self).__name__, actor_network, "modules.tanh_normal_actor")
        need_kind(type(self).__name__, actor_network, self.takes_discrete)
        self.set_distance(loss_function)
        if subset is not None and not 1 <= subset <= self.num_critics:
            raise UserError(f"subset={subset} of {self.num_critics} critics: give a number from 1 to the latter")
        if actor_value not in _ACTOR_VALUES:
            raise UserError(f"actor_value={actor_value!r}: give 'min' or 'mean'")
        self.subset, self.actor_value = subset, _ACTOR_VALUES[actor_value]
        spec = action_spec_of(actor_network, self.tensor_keys.action, action_spec)
        target = self.automatic_entropy(spec) if target_entropy == "auto" else float(target_entropy)
        self._automatic = temperature is None and target is None
        if temperature is not None:
            self.temperature: Any = _checked(temperature)
        else:  # where the target is not known yet, each batch adds it to 0
            bounds = {"min_alpha": min_alpha, "max_alpha": max_alpha}
            made = Temperature(target or 0.0, alpha_init, **bounds, trained=not fixed_alpha)
            self.temperature = made.to(next(self.parameters()).device)
            if fixed_alpha:  # by TorchRL's name
                self.register_buffer("log_alpha", self.temperature.log_alpha)
            else:
                self.log_alpha = self.temperature.log_alpha

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> SoftQLoss:
        super()._apply(fn)
        if "log_alpha" in self._buffers:
            self._buffers["log_alpha"] = self.temperature.log_alpha  # it is another, of the new type or device
        return self

    def automatic_entropy(self, spec: Any) -> float | None:
        """The target entropy that ``auto`` means: minus the dimensions of the action; None without its spec."""
        return None if spec is None else -float(dimensions(spec))

    def seen_entropy(self, action: Any, log_prob: Tensor) -> float:
        """The same, read off a batch of actions and their log-probabilities."""
        parts = [action] if isinstance(action, Tensor) else list(action.values(True, True))
        return -sum(part.numel() for part in parts) / log_prob.numel()

    @property
    def alpha(self) -> Tensor:
        r"""The temperature :math:`\alpha`, a detached scalar."""
        return self.temperature.alpha.detach().clone()  # a controller may move it while the loss is computed

    @property
    def target_entropy(self) -> Tensor:
        r""":math:`\bar H`, a scalar; with ``auto``, known where the loss or the actor has the action's spec."""
        if self._automatic:
            raise UserError("target_entropy='auto' is read off each batch: give action_spec= to know it before")
        target = getattr(self.temperature, "target_entropy", None)
        if target is None:
            raise UserError(f"{type(self.temperature).__name__} has no target_entropy")
        return target

    def draw(self) -> Tensor | None:
        """The critics that make this call's target, ``[subset]``; None: all."""
        if self.subset is None or self.subset == self.num_critics:  # inductor 2.13 cannot compile x[randperm(n)]
            return None
        return random_subset(self.num_critics, self.subset, self.gamma.device)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` of transitions; nothing in it is changed, ``td_error`` is added."""
        batch, alpha = tensordict, self.alpha

        with torch.no_grad():
            members = self.draw()
            next_action, next_log_prob = self.act(batch["next"], self.target_actor_network_params)
            min_q = self.min_q(batch["next"], next_action, self.target_qvalue_network_params, members)
            target = self.target(batch, min_q - alpha * next_log_prob)

        outputs = self.outputs(batch, batch[self.tensor_keys.action], self.qvalue_network_params)
        loss_qvalue, q = self.regress(batch, outputs, target)

        batch = self.first(batch)
        action, log_prob = self.act(batch, self.actor_network_params)
        value = self.actor_value(self.q(batch, action, self.qvalue_network_params.detach()))
        same_shape(log_prob=log_prob, value=value)
        loss_actor = self.reduce(alpha * log_prob - value, batch)
        return self.result(batch, loss_actor, loss_qvalue, action, log_prob, q)

    def result(
        self,
        batch: TensorDictBase,
        loss_actor: Tensor,
        loss_qvalue: Tensor,
        action: Any,
        log_prob: Tensor,
        q: Tensor,
        out_of_reach: Tensor | float = 0.0,
    ) -> TensorDict:
        """The losses, that of the temperature included, and the metrics.

        Args:
            batch: what the actor learned on, ``[*B]``.
            loss_actor, loss_qvalue: reduced.
            action: drawn there, ``[*B, actions]``.
            log_prob: its log-probability, ``[*B]``.
            q: the mean of the critics' values of the batch's actions, ``[]``.
            out_of_reach: the part of the target entropy that is not asked of a row, ``[*B]``.
        """
        entropy = -log_prob.detach()
        missing = (self.seen_entropy(action, log_prob) if self._automatic else 0.0) - out_of_reach
        loss_alpha = self.reduce(self.temperature.loss(missing - entropy), batch)
        out = TensorDict({"loss_actor": loss_actor, "loss_qvalue": loss_qvalue, "loss_alpha": loss_alpha})
        out["alpha"], out["entropy"], out["q_value"] = self.alpha, self.average(entropy, batch), q
        return out

    def _writes(self) -> list[NestedKey]:
        return ["loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "q_value"]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        if f"{prefix}log_alpha" in state_dict:  # all that was saved when this loss had no temperature block
            state_dict.setdefault(f"{prefix}temperature.log_alpha", state_dict[f"{prefix}log_alpha"])
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


@runtime_checkable
class _Weight(Protocol):
    """The weight of the entropy."""

    alpha: Tensor

    def loss(self, log_prob: Tensor, /) -> Tensor: ...


def _checked(temperature: nn.Module) -> nn.Module:
    if not isinstance(temperature, _Weight):
        raise UserError(
            f"temperature={temperature!r}: give a block with alpha and loss (controllers.Temperature, "
            "controllers.FixedTemperature(0.2))"
        )
    if not (isinstance(temperature.alpha, Tensor) and temperature.alpha.numel() == 1):
        raise UserError(f"{type(temperature).__name__}.alpha is {temperature.alpha!r}: make it a tensor of one number")
    return temperature
