"""TorchRL's plumbing of the losses of an actor and action values on replayed data, written once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.modules import Delta, TanhDelta
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives.utils import ValueEstimators, _vmap_func

from pgkit.errors import UserError, within
from pgkit.functional import bootstrap_target
from pgkit.heads import Head, Scalar
from pgkit.losses.base import Loss


class QLoss(Loss):
    """Base of the losses of an actor and an ensemble of action values, with delayed target networks.

    It holds the networks as TorchRL does (``qvalue_network_params``, ``target_qvalue_network_params``, ...), owns the
    discount, names the keys, and gives subclasses these verbs: :meth:`act` (for a deterministic actor :meth:`action`),
    :meth:`q`, :meth:`target`, :meth:`write_priority`.

    Args:
        actor_network: probabilistic actor, or a deterministic one.
        qvalue_network: an ensemble, ``state_action_value [*B, critics]`` (with a head ``[*B, critics, size]``) and an
            attribute ``num_critics`` (:func:`pgkit.modules.q_value`); or a list of modules with ``[*B, 1]``; or one
            such module, which is copied ``num_qvalue_nets`` times with weights drawn again, as in TorchRL. A list of
            one, or one with ``num_qvalue_nets=1``, is used as it is.
        num_qvalue_nets: how many critics; an ensemble or a list brings its own number.
        gamma: discount. This loss is its only owner.
        delay_actor: use a delayed actor in the target.
        delay_qvalue: use delayed critics in the target.
        separate_losses: parameters that both networks share are trained by the policy's loss only.
        reduction: ``mean``, ``sum`` or ``none``.
        head: what the critics' outputs stand for, one of :mod:`pgkit.heads`; None: the network's own, or else a scalar.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change, with TorchRL's names and defaults."""

        action: NestedKey = "action"
        log_prob: NestedKey = "action_log_prob"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"

    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    gamma: Tensor
    qvalue_network: TensorDictModule
    qvalue_network_params: Any
    target_qvalue_network_params: Any

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        num_qvalue_nets: int = 2,
        gamma: float = 0.99,
        delay_actor: bool = False,
        delay_qvalue: bool = True,
        separate_losses: bool = False,
        reduction: str | None = None,
        head: Head | None = None,
    ) -> None:
        super().__init__(reduction)
        within(0, 1, gamma=gamma)
        self.register_coeff_buffer("gamma", gamma)
        self.delay_actor, self.delay_qvalue = delay_actor, delay_qvalue
        self.convert_to_functional(actor_network, "actor_network", create_target_params=delay_actor)
        several = isinstance(qvalue_network, Sequence) and not isinstance(qvalue_network, torch.nn.Module)
        networks = list(qvalue_network) if several else [qvalue_network]
        alone = len(networks) == 1 and (several or num_qvalue_nets == 1 or hasattr(networks[0], "num_critics"))
        number = len(networks) if several else num_qvalue_nets
        self.num_critics = getattr(networks[0], "num_critics", 1) if alone else number
        own = getattr(networks[0], "head", None)
        self.head = head or (own if isinstance(own, Head) else Scalar())
        self.convert_to_functional(
            networks if len(networks) > 1 else networks[0],
            "qvalue_network",
            None if alone else number,
            create_target_params=delay_qvalue,
            compare_against=list(actor_network.parameters()) if separate_losses else None,
        )
        self._alone = alone
        self._make_vmap()
        if hasattr(actor_network, "dist_sample_keys"):
            self.set_keys(action=actor_network.dist_sample_keys[0], log_prob=actor_network.log_prob_keys[0])

    def _make_vmap(self) -> None:  # TorchRL's hook: again after set_vmap_randomness
        of_each = None if self._alone else _vmap_func(self.qvalue_network, (None, 0), randomness=self.vmap_randomness)
        self._each = of_each

    def set_distance(self, loss_function: str) -> None:
        """The distance of scalar critics that have no head of their own: ``l2``, ``l1`` or ``smooth_l1``."""
        if self.head == Scalar():
            self.head = Scalar(loss_function)
        elif loss_function != "l2":
            raise UserError(f"loss_function={loss_function!r} is for critics without a head, these have {self.head}")

    def act(self, batch: TensorDictBase, params: Any) -> tuple[Tensor, Tensor]:
        """An action drawn from the policy at the batch's observations, and its log-probability ``[*B]``: one draw."""
        with params.to_module(self.actor_network, preserve_module_state=False):
            dist = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))
        return rsample_and_log_prob(dist)

    def action(self, batch: TensorDictBase, params: Any) -> Tensor:
        """A deterministic actor's action ``[*B, actions]`` at the batch's observations."""
        with params.to_module(self.actor_network, preserve_module_state=False):
            out = self.actor_network(batch.select(*self.actor_network.in_keys))
        return out.get(self.tensor_keys.action)

    def returns(
        self, batch: TensorDictBase, action: Tensor, params: Any, members: Tensor | slice | None = None
    ) -> Tensor:
        """What the head reads, ``[*B, critics, size]``, for ``action`` at the batch's observations.

        ``members`` names the critics to evaluate, in the order of the result; None: all.

        Raises:
            UserError: the critics' outputs are not those of this number of critics or not those of the head.
        """
        data = batch.select(*self.qvalue_network.in_keys, strict=False).set(self.tensor_keys.action, action)
        number = self.num_critics if members is None else None
        params, members = self.params_of(params, members)
        if self.tensor_keys.state_action_value not in self.qvalue_network.out_keys:
            raise UserError(
                f"{type(self).__name__} reads '{self.tensor_keys.state_action_value}' of its critics, they write "
                f"{', '.join(map(str, self.qvalue_network.out_keys))}: give modules.q_value(env), or set_keys(...)"
            )
        if self._each is not None:
            out = self._each(data, params).get(self.tensor_keys.state_action_value)
            out = (out if out.dim() == data.dim() + 2 else out.squeeze(-2)).movedim(0, -2)
        else:
            with params.to_module(self.qvalue_network, preserve_module_state=False):
                out = self.qvalue_network(data).get(self.tensor_keys.state_action_value)
            if out.dim() == data.dim() + 1:  # [*B, critics], or what a single critic with a head writes
                out = out.unsqueeze(-2 if self.head.size > 1 and self.num_critics == 1 else -1)
        if (out.shape[-1] > 1) != (self.head.size > 1) or out.shape[-2] != (number or out.shape[-2]):
            outputs = "one output" if self.head.size == 1 else f"{self.head.size} outputs"
            advice = f"give the critics the head (modules.q_value(env, {self.num_critics}, head=...))"
            if self.head.size == 1:
                advice += f", or, if one network writes several critics' values, network.num_critics = {out.shape[-1]}"
            raise UserError(
                f"{self.head} needs {outputs} of each of the {self.num_critics} critics, there are "
                f"{out.shape[-1]} of {out.shape[-2]}: {advice}"
            )
        return out if members is None else out[..., members, :]

    def params_of(self, params: Any, members: Tensor | slice | None) -> tuple[Any, Tensor | slice | None]:
        """``params`` of the critics ``members``, None: of all; and what is left to take out of the results."""
        if members is None:
            return params, None
        if self._each is not None:
            return params[members], None
        pick = getattr(self.qvalue_network, "members", None)
        picked = None if pick is None else pick(params, members)
        return (params, members) if picked is None else (picked, None)

    def q(self, batch: TensorDictBase, action: Tensor, params: Any, members: Tensor | slice | None = None) -> Tensor:
        """The critics' values ``[*B, critics]`` of ``action`` at the batch's observations."""
        return self.head.mean(self.returns(batch, action, params, members))

    def target(self, batch: TensorDictBase, next_value: Tensor) -> Tensor:
        """The bootstrapped target of the next state's value ``[*B]``, or of its atoms ``[*B, K]``; same shape."""
        keys, after = self.tensor_keys, batch["next"]
        atoms = next_value.reshape(*batch.batch_size, -1)
        reward, terminated = (after[key].expand_as(atoms) for key in (keys.reward, keys.terminated))
        steps = batch.get(keys.steps_to_next_obs, None)
        steps = None if steps is None else steps.reshape(*batch.batch_size, 1)  # TorchRL's MultiStep drops the 1
        return bootstrap_target(reward, atoms, terminated, self.gamma, steps).reshape(next_value.shape)

    def weight(self, batch: TensorDictBase) -> Tensor | float:
        """The importance weights ``[*B]`` of a prioritized replay, 1 for any other."""
        weight = batch.get(self.tensor_keys.priority_weight, None)
        return 1.0 if weight is None else weight.reshape(batch.batch_size)

    def write_priority(self, batch: TensorDictBase, td_error: Tensor) -> None:
        """Writes the largest error of the critics, ``[*B, critics]`` in absolute value, into the batch."""
        batch.set(self.tensor_keys.priority, td_error.detach().abs().amax(-1))

    def make_value_estimator(self, value_type: ValueEstimators | None = None, **hyperparams: Any) -> QLoss:
        """As in TorchRL: sets ``gamma``. One- and n-step targets come from the replay, so only ``TD0`` is known."""
        if value_type not in (None, ValueEstimators.TD0):
            raise NotImplementedError(f"{type(self).__name__} takes TD0; for n-step targets give the replay n_steps=")
        unknown = hyperparams.keys() - {"gamma", "device"}
        if unknown:
            raise TypeError(f"unknown settings of the value estimator: {', '.join(unknown)}")
        if "gamma" in hyperparams:
            self.gamma.fill_(hyperparams["gamma"])
        return self

    def _reads(self) -> list[NestedKey]:
        keys, networks = self.tensor_keys, [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        after = [*[key for key in networks if key != keys.action], keys.reward, keys.done, keys.terminated]
        return [keys.action, *networks, *[("next", *((key,) if isinstance(key, str) else key)) for key in after]]


def refuse_stochastic(loss: str, actor: TensorDictModule) -> None:
    """Raises ``UserError`` for an actor that draws its actions from a distribution."""
    kinds = [getattr(module, "distribution_class", None) for module in actor.modules()]
    if any(kind is not None and not issubclass(kind, Delta | TanhDelta) for kind in kinds):
        raise UserError(
            f"{loss} needs an actor that gives one action, this one draws it from a distribution: use "
            "modules.deterministic_actor, or losses.SACLoss for this actor"
        )
