"""TorchRL's plumbing of the losses of an actor and action values on replayed data, written once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypedDict, TypeVar, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.sac import compute_rsample_log_prob
from torchrl.objectives.utils import ValueEstimators, _vmap_func

from pgkit.errors import UserError, within
from pgkit.functional import bootstrap_target
from pgkit.heads import Head, Returns, Scalar
from pgkit.losses.actors import PROBABILISTIC
from pgkit.losses.base import Loss, masks_of

Critics = TensorDictModule | Sequence[TensorDictModule]
Members = Tensor | slice | None
Value = TypeVar("Value", Tensor, Returns)


class QSettings(TypedDict, total=False):
    """Keywords of :class:`QLoss`, which says what they mean and what they default to."""

    num_qvalue_nets: int
    gamma: float
    delay_actor: bool
    delay_qvalue: bool
    separate_losses: bool
    augmented: bool
    reduction: str | None
    head: Head | None


class QLoss(Loss):
    """Base of the losses of an actor and an ensemble of action values, with delayed target networks.

    It holds the networks as TorchRL does (``qvalue_network_params``, ``target_qvalue_network_params``, ...), owns the
    discount, names the keys, and gives subclasses these verbs: :meth:`act` (for a deterministic actor :meth:`action`),
    :meth:`min_q`, :meth:`target`, :meth:`outputs`, :meth:`regress`, :meth:`q`, :meth:`write_priority`.

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
        augmented: a batch is ``[copies, *B]``, copies of the same transitions that an augmentation changed: their
            targets and the critics' losses are averaged, the actor learns on the first copy (DrQ, Yarats et al., 2021,
            https://arxiv.org/abs/2004.13649).
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
        qvalue_network: Critics,
        *,
        num_qvalue_nets: int = 2,
        gamma: float = 0.99,
        delay_actor: bool = False,
        delay_qvalue: bool = True,
        separate_losses: bool = False,
        augmented: bool = False,
        reduction: str | None = None,
        head: Head | None = None,
    ) -> None:
        super().__init__(reduction)
        within(0, 1, gamma=gamma)
        self.delay_actor, self.delay_qvalue, self.augmented = delay_actor, delay_qvalue, augmented
        self.convert_to_functional(actor_network, "actor_network", create_target_params=delay_actor)
        networks, self.num_critics, self._together = _arranged(qvalue_network, num_qvalue_nets)
        self.head = head or head_of(networks[0]) or Scalar()
        self.convert_to_functional(
            networks if len(networks) > 1 else networks[0],
            "qvalue_network",
            None if self._together else self.num_critics,
            create_target_params=delay_qvalue,
            compare_against=list(actor_network.parameters()) if separate_losses else None,
        )
        self.register_coeff_buffer("gamma", gamma, dtype=torch.float64)
        self._make_vmap()
        self.group = group_of(networks[0])
        if self.group:
            below = ("action", "reward", "state_action_value")
            self.set_keys(**{name: (*self.group, name) for name in below})
        if isinstance(actor_network, PROBABILISTIC):
            self.set_keys(action=actor_network.dist_sample_keys[0], log_prob=actor_network.log_prob_keys[0])

    def _make_vmap(self) -> None:  # TorchRL's hook: again after set_vmap_randomness
        if not self._together:
            self._each = _vmap_func(self.qvalue_network, (None, 0), randomness=self.vmap_randomness)

    def set_distance(self, loss_function: str) -> None:
        """The distance of scalar critics that have no head of their own: ``l2``, ``l1`` or ``smooth_l1``."""
        if self.head == Scalar():
            self.head = Scalar(loss_function)
        elif loss_function != "l2":
            raise UserError(f"loss_function={loss_function!r} is for critics without a head, these have {self.head}")

    def act(self, batch: TensorDictBase, params: Any) -> tuple[Any, Tensor]:
        """An action drawn from the policy at the batch's observations, and its log-probability ``[*B]``: one draw."""
        with params.to_module(self.actor_network, preserve_module_state=False):
            dist = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys, strict=False))
        return compute_rsample_log_prob(dist)

    def action(self, batch: TensorDictBase, params: Any) -> Tensor:
        """A deterministic actor's action ``[*B, actions]`` at the batch's observations."""
        with params.to_module(self.actor_network, preserve_module_state=False):
            out = self.actor_network(batch.select(*self.actor_network.in_keys))
        return out.get(self.tensor_keys.action)

    def outputs(self, batch: TensorDictBase, action: Any, params: Any, members: Members = None) -> Tensor:
        """What the head reads, ``[*B, critics, size]``, for ``action`` at the batch's observations.

        ``members`` names the critics to evaluate, in the order of the result; None: all.

        Raises:
            UserError: the critics' outputs are not those of this number of critics or not those of the head.
        """
        data = batch.select(*self.qvalue_network.in_keys, strict=False).set(self.tensor_keys.action, action)
        out = self.evaluate(data, self.tensor_keys.state_action_value, params, members)
        if (out.shape[-1] > 1) != (self.head.size > 1) or (members is None and out.shape[-2] != self.num_critics):
            raise UserError(self._other_outputs(out))
        return out

    def evaluate(self, data: TensorDictBase, key: NestedKey, params: Any, members: Members = None) -> Tensor:
        """The critics' entry ``key`` as ``[*B, critics, size]``, whether one network writes it or each its own.

        Of a group of agents ``[*B, agents, critics, size]``; so has all else here that is for each row.
        """
        if key not in self.qvalue_network.out_keys:
            raise UserError(
                f"{type(self).__name__} reads '{key}' of its critics, they write "
                f"{', '.join(map(str, self.qvalue_network.out_keys))}: give modules.q_value(env), or set_keys(...)"
            )
        if members is not None:
            params, members = self._params_of(params, members)
        dims = data.dim() + bool(self.group)
        if self._together:
            with params.to_module(self.qvalue_network, preserve_module_state=False):
                out = self.qvalue_network(data).get(key)
            out = out.unsqueeze(dims) if self.num_critics == 1 else out  # [*B, size]
        else:
            each: Any = self._each
            out = each(data, params).get(key).movedim(0, dims)
        out = out.unsqueeze(-1) if out.dim() == dims + 1 else out.flatten(dims + 1)
        return out if members is None else out[..., members, :]

    def _params_of(self, params: Any, members: Tensor | slice) -> tuple[Any, Members]:
        """``params`` of the critics ``members``, and what is left to take out of the results."""
        if not self._together:
            return params[members], None
        pick = getattr(self.qvalue_network, "members", None)
        picked = None if pick is None else pick(params, members)
        return (params, members) if picked is None else (picked, None)

    def _other_outputs(self, out: Tensor) -> str:
        wanted = "one output" if self.head.size == 1 else f"{self.head.size} outputs"
        advice = f"give the critics the head (modules.q_value(env, {self.num_critics}, head=...))"
        if self.head.size == 1:
            written = out.shape[-2] * out.shape[-1]
            advice += f", or, if one network writes several critics' values, network.num_critics = {written}"
        return (
            f"{self.head} needs {wanted} of each of the {self.num_critics} critics, there are "
            f"{out.shape[-1]} of {out.shape[-2]}: {advice}"
        )

    def min_q(self, batch: TensorDictBase, action: Any, params: Any, members: Members = None) -> Returns:
        r"""The least of the critics' returns of ``action``, :math:`\min_i Q_i`; each head has its own least."""
        return self.head.least(self.outputs(batch, action, params, members))

    def q(self, batch: TensorDictBase, action: Any, params: Any, members: Members = None) -> Tensor:
        """The critics' values ``[*B, critics]`` of ``action`` at the batch's observations."""
        return self.head.mean(self.outputs(batch, action, params, members))

    def target(self, batch: TensorDictBase, next_value: Value) -> Value:
        r"""The bootstrapped target :math:`r + \gamma^n (1 - \text{terminated}) V(s_{t+n})`, ``[*B]``.

        Of a number ``[*B]`` or of a distribution of returns; of augmented copies, the mean over them.
        """
        keys, after = self.tensor_keys, batch["next"]
        own = (*self.group, "terminated")  # an agent's own end, where the environment has one
        ends = own if self.group and own in after.keys(True, True) else keys.terminated
        reward = self.by_row(after[keys.reward], batch)
        terminated = self.by_row(after[ends], batch).expand_as(reward)
        gamma, steps = self.gamma.to(next_value.dtype), batch.get(keys.steps_to_next_obs, None)
        if steps is not None:  # TorchRL's MultiStep drops the 1; a power of whole numbers would be float32 for any
            steps = self.by_row(steps, batch).expand_as(reward).to(gamma.dtype)
        target: Any = bootstrap_target(reward, next_value, terminated, gamma, steps)
        if self.augmented:
            target = target.mixed() if isinstance(target, Returns) else target.mean(0, keepdim=True).expand_as(target)
        return cast(Value, target)

    def regress(self, batch: TensorDictBase, outputs: Tensor, target: Returns) -> tuple[Tensor, Tensor]:
        """The loss of the critics' ``outputs [*B, critics, size]`` at the target, reduced, and their mean value.

        Writes the priority, and weighs each row by the importance weight of a prioritized replay.

        Returns:
            The loss, and a metric ``[]``.
        """
        q = self.head.mean(outputs)
        self.write_priority(batch, q - target.mean.unsqueeze(-1))
        weight = batch.get(self.tensor_keys.priority_weight, None)
        loss = self.head.loss(outputs, target).sum(-1)
        loss = loss if weight is None else loss * self.by_row(weight, batch)
        return self.reduce(loss, batch), self.average(q.mean(-1), batch)

    def by_row(self, entry: Tensor, batch: TensorDictBase) -> Tensor:
        """An entry without its trailing 1, ``[*B]``; of a group ``[*B, agents]``, or ``[*B, 1]`` of what all share."""
        return entry.reshape(*batch.batch_size, -1) if self.group else entry.reshape(batch.batch_size)

    def _loss_mask_keys(self) -> tuple[NestedKey, ...]:
        return masks_of(super()._loss_mask_keys(), self.tensor_keys.action, self.loss_mask_key)

    def write_priority(self, batch: TensorDictBase, td_error: Tensor) -> None:
        """Writes the largest error of the critics, of agents too, in absolute value; 0 for what a mask leaves out."""
        error = self._reduce_loss(td_error.detach().abs().amax(-1), batch, reduction="none")
        batch.set(self.tensor_keys.priority, error.reshape(*batch.batch_size, -1).amax(-1))

    def first(self, batch: Any) -> Any:
        """What the actor learns on, of a batch or a tensor: all of it, of augmented copies the first."""
        return batch[0] if self.augmented else batch

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


def _arranged(critics: Critics, number: int) -> tuple[list[Any], int, bool]:
    """The critics' networks, how many critics these are, and whether one network is used as it is."""
    several = isinstance(critics, list | tuple)
    networks = list(critics) if several else [critics]
    own = getattr(networks[0], "num_critics", None)
    if len(networks) == 1 and (several or number == 1 or own is not None):
        return networks, own or 1, True
    return networks, len(networks) if several else number, False


def group_of(critic: Any) -> tuple[str, ...]:
    """The path of the group of agents that a critic is for: ``("agents",)``; ``()`` of one agent."""
    value = next((key for key in critic.out_keys if key[-1] == "state_action_value"), "state_action_value")
    return () if isinstance(value, str) else value[:-1]


def head_of(critics: Critics) -> Head | None:
    """The head that the critics bring along."""
    head = getattr(critics[0] if isinstance(critics, list | tuple) else critics, "head", None)
    return head if isinstance(head, Head) else None
