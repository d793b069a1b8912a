"""TorchRL's plumbing of the losses of an actor and a state value on on-policy data, written once."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypedDict

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CompositeDistribution, TensorDictModule, set_composite_lp_aggregate
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution, kl_divergence
from torchrl.modules.distributions.utils import sample_and_log_prob
from torchrl.objectives.utils import ValueEstimators, dispatch_value_estimator

from pgkit.functional import (
    approx_kl,
    clipped_value_loss,
    explained_variance,
    listed,
    same_shape,
    standardize,
    value_loss,
)
from pgkit.functional.modes import in_evaluation
from pgkit.functional.values import Distance
from pgkit.losses.actors import need_distribution
from pgkit.losses.base import Loss, masks_of


class PolicySettings(TypedDict, total=False):
    """Keywords of :class:`PolicyLoss`, which says what they mean and what they default to."""

    entropy_coeff: float
    critic_coeff: float | None
    loss_critic_type: str | Distance
    normalize_advantage: bool
    clip_value: bool | float | None
    entropy_bonus: bool
    samples_mc_entropy: int
    separate_losses: bool
    reduction: str | None


class PolicyLoss(Loss):
    """Base of the losses of an actor and a state-value critic on on-policy data, with TorchRL's settings.

    It holds both networks as TorchRL losses do (``actor_network``, ``actor_network_params``, ...), names the keys,
    and gives subclasses verbs: :meth:`distribution`, :meth:`log_prob`, :meth:`log_ratio`, :meth:`kl`, :meth:`value`;
    and :meth:`result`, or its parts :meth:`add_entropy` and :meth:`add_critic`.

    The actor is evaluated in evaluation mode (no dropout, normalization by running statistics), as it collects: the
    first ratio is 1. The critic keeps the mode that it was given in.

    Args:
        actor_network: probabilistic actor.
        critic_network: value operator; None leaves the value loss out.
        entropy_coeff: weight of the entropy bonus.
        critic_coeff: weight of the value loss; None or 0 leaves it out.
        loss_critic_type: ``l2``, ``l1``, ``smooth_l1``, or a function ``(value, target) -> loss``, unreduced.
        normalize_advantage: zero mean and unit deviation within the minibatch.
        clip_value: clip the value's change to this distance from ``state_value``.
        entropy_bonus: False leaves entropy out altogether.
        samples_mc_entropy: draws that estimate the entropy of a distribution without a closed form.
        separate_losses: parameters that both networks share are trained by the policy's loss only.
        reduction: ``mean``, ``sum`` or ``none``.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change, with TorchRL's names and defaults."""

        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        sample_log_prob: NestedKey = "action_log_prob"
        action: NestedKey = "action"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.GAE
    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset({"entropy_coeff", "critic_coeff", "clip_value"})
    entropy_coeff: Tensor
    critic_coeff: Tensor
    clip_value: Tensor | None
    critic_network: TensorDictModule | None
    critic_network_params: Any
    target_critic_network_params: Any

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule | None = None,
        *,
        entropy_coeff: float = 0.0,
        critic_coeff: float | None = 1.0,
        loss_critic_type: str | Distance = "l2",
        normalize_advantage: bool = False,
        clip_value: float | None = None,
        entropy_bonus: bool = True,
        samples_mc_entropy: int = 1,
        separate_losses: bool = False,
        reduction: str | None = None,
    ) -> None:
        super().__init__(reduction)
        self.convert_to_functional(actor_network, "actor_network")
        need_distribution(type(self).__name__, actor_network, "modules.gaussian_actor, modules.actor")
        if critic_network is None or not critic_coeff:
            self.critic_network = None
        else:
            shared = list(actor_network.parameters()) if separate_losses else None
            self.convert_to_functional(critic_network, "critic_network", compare_against=shared)
        several = (list(actor_network.dist_sample_keys), list(actor_network.log_prob_keys))
        action, log_prob = (keys[0] if len(keys) == 1 else keys for keys in several)
        self.set_keys(action=action, sample_log_prob=log_prob, **_under_group(critic_network))
        for name, value in {
            "entropy_coeff": entropy_coeff,
            "critic_coeff": critic_coeff,
            "clip_value": clip_value,
        }.items():
            self.register_coeff_buffer(name, value, dtype=torch.float64)
        self.loss_critic_type, self.normalize_advantage = loss_critic_type, normalize_advantage
        self.entropy_bonus, self.samples_mc_entropy = entropy_bonus, samples_mc_entropy

    def distribution(self, batch: TensorDictBase) -> Distribution:
        """The policy's distribution at the batch's observations; the batch is left as it is."""
        with self.actor_network_params.to_module(self.actor_network), in_evaluation(self.actor_network):
            entries = batch.select(*self.actor_network.in_keys, strict=False)  # a composite's "params" it writes itself
            return self.actor_network.get_dist(entries)

    def log_prob(self, dist: Distribution, batch: TensorDictBase) -> Tensor:
        """Log-probability of the batch's actions, ``[*B]``; of a composite action, that of all its parts.

        Raises:
            RuntimeError: an action has a gradient of its own, from a draw that was made with gradients on: it would
                cancel part of the loss's.
        """
        for key in listed(self.tensor_keys.action):
            if batch[key].requires_grad:
                raise RuntimeError(
                    f"tensordict stored {key} requires grad: collect under torch.no_grad(), or give the loss "
                    "rollout.detach()"
                )
        if isinstance(dist, CompositeDistribution):
            with set_composite_lp_aggregate(True):
                return dist.log_prob(batch)
        return dist.log_prob(batch[self.tensor_keys.action])

    def log_ratio(self, dist: Distribution, batch: TensorDictBase) -> Tensor:
        r""":math:`\log \pi(a|s) - \log \pi_{old}(a|s)` of the batch's actions, ``[*B, 1]``."""
        log_prob = self.log_prob(dist, batch)
        old_log_prob = torch.stack([batch[key] for key in listed(self.tensor_keys.sample_log_prob)]).sum(0)
        same_shape(log_prob=log_prob, old_log_prob=old_log_prob)
        return (log_prob - old_log_prob).unsqueeze(-1)

    def keep_distribution(self, batch: TensorDictBase) -> TensorDictBase:
        """Writes the policy's distribution into the batch (``loc`` and ``scale``, or ``logits``), as of now."""
        actor = self.actor_network
        with torch.no_grad(), self.actor_network_params.to_module(actor), in_evaluation(actor):
            out = actor.get_dist_params(batch.select(*actor.in_keys))
        return batch.update(out.select(*self.distribution_keys))

    @property
    def distribution_keys(self) -> list[NestedKey]:
        """Where :meth:`keep_distribution` writes and TorchRL's collectors do: the distribution's parameters."""
        head: Any = self.actor_network
        return list(head[-1].in_keys)

    def kl(self, batch: TensorDictBase, dist: Distribution | None = None) -> Tensor:
        r""":math:`KL(\pi_{old} \| \pi)` ``[*B]`` from the distribution kept in the batch to the present one.

        In closed form where the distributions have one, otherwise estimated from the batch's actions.
        """
        dist = self.distribution(batch) if dist is None else dist
        missing = [key for key in self.distribution_keys if key not in batch.keys(True)]
        if missing:
            raise KeyError(
                f"the batch has no '{missing[0]}', a parameter of the distribution that acted: call "
                "loss.keep_distribution(rollout) before the update"
            )
        old = self.actor_network.build_dist_from_params(batch.select(*self.distribution_keys))
        try:
            return kl_divergence(old, dist)
        except NotImplementedError:
            return approx_kl(self.log_ratio(dist, batch)).squeeze(-1)

    def value(self, batch: TensorDictBase) -> Tensor:
        """The critic's value of the batch's observations, ``[*B, 1]``."""
        assert self.critic_network is not None
        with self.critic_network_params.to_module(self.critic_network):
            out = self.critic_network(batch.select(*self.critic_network.in_keys))
        return out[self.tensor_keys.value]

    def entropy(self, dist: Distribution) -> Tensor:
        """Entropy ``[*B]``: in closed form, or minus the mean log-probability of ``samples_mc_entropy`` draws."""
        if isinstance(dist, CompositeDistribution):
            with set_composite_lp_aggregate(True):
                return dist.entropy(self.samples_mc_entropy)
        try:
            return dist.entropy()
        except NotImplementedError:
            draws = range(self.samples_mc_entropy)
            log_prob = torch.stack([sample_and_log_prob(dist, reparameterize=dist.has_rsample)[1] for _ in draws])
            if not dist.has_rsample:  # no gradient through the draw: that of its probability, E[log p grad log p]
                score = log_prob.detach()
                log_prob = score + score * log_prob - score.square()
            return -log_prob.mean(0)

    def get_advantage(self, batch: TensorDictBase) -> Tensor:
        """The batch's advantage ``[*B, 1]``, standardized over the batch if this loss does that.

        This loss's own estimator computes it only if the user made one and the batch has none.
        """
        if self.tensor_keys.advantage not in batch.keys(True):
            if self._value_estimator is None:
                raise KeyError(
                    f"the batch has no '{self.tensor_keys.advantage}', which {type(self).__name__} reads: run an "
                    "advantage block on the rollout first (advantages.GAE(critic)(rollout))"
                )
            self._value_estimator(
                batch,
                params=self.critic_network_params.detach(),
                target_params=self.target_critic_network_params,
            )
        advantage = self.counted(batch.get(self.tensor_keys.advantage), batch)
        return standardize(advantage, self.mask(advantage, batch)) if self.normalize_advantage else advantage

    def mask(self, entry: Tensor, batch: TensorDictBase) -> Tensor | None:
        """Which elements of an entry ``[*B, 1]`` are no padding, in its shape; None if the batch has no mask."""
        found = [x for key in self._loss_mask_keys() if (x := batch.get(key, None)) is not None]
        return torch.stack([self._expand_loss_mask(x, entry) for x in found]).all(0) if found else None

    def counted(self, entry: Tensor, batch: TensorDictBase) -> Tensor:
        """An entry ``[*B, 1]`` with 0 in place of padding, which may be NaN: 0 times that is no gradient of 0."""
        mask = self.mask(entry, batch)
        return entry if mask is None else torch.where(mask, entry, 0.0)

    def _loss_mask_keys(self) -> tuple[NestedKey, ...]:
        return masks_of(super()._loss_mask_keys(), self.tensor_keys.action, self.loss_mask_key)

    def result(self, batch: TensorDictBase, objective: Tensor, dist: Distribution) -> TensorDict:
        """Losses and metrics of an unreduced ``objective [*B, 1]``, to be maximized; of entropy and value too."""
        out = TensorDict({"loss_objective": self.reduce(-objective, batch)})
        self.add_entropy(out, dist, batch)
        self.add_critic(out, batch)
        return out

    def add_entropy(self, out: TensorDict, dist: Distribution, batch: TensorDictBase) -> None:
        """Writes ``loss_entropy`` and ``entropy``, unless there is no entropy bonus."""
        if self.entropy_bonus:
            entropy = self.entropy(dist)
            out["loss_entropy"] = self.reduce(-self.entropy_coeff * entropy, batch)
            out["entropy"] = self.average(entropy, batch)

    def add_critic(self, out: TensorDict, batch: TensorDictBase, name: str = "loss_critic") -> None:
        """Writes the value loss as ``name``, and ``explained_variance``, unless there is no critic."""
        if self.critic_network is None:
            return
        value, target = self.value(batch), self.counted(batch[self.tensor_keys.value_target], batch)
        if self.clip_value is None:
            error = value_loss(value, target, self.loss_critic_type)
        else:
            old_value = batch[self.tensor_keys.value]
            error = clipped_value_loss(value, target, old_value, self.clip_value, self.loss_critic_type)
        out[name] = self.reduce(self.critic_coeff * error, batch)
        out["explained_variance"] = explained_variance(value.detach(), target, self.mask(target, batch))

    def make_value_estimator(self, value_type: ValueEstimators | None = None, **hyperparams: Any) -> PolicyLoss:
        """As in TorchRL; returns the loss."""
        value_type, hp = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if value_type is not None:
            keys = {name: key for name, key in vars(self.tensor_keys).items() if name != "action"}
            supported = {value_type: value_type.name}
            dispatch_value_estimator(self, value_type, supported=supported, tensor_keys=keys, **hp)
        self._in_keys = None
        return self

    def _reads(self) -> list[NestedKey]:
        networks = [net for net in (self.actor_network, self.critic_network) if net is not None]
        return [*[key for net in networks for key in net.in_keys], *self._read_keys(), *self._estimated_from()]

    def _estimated_from(self) -> list[NestedKey]:
        """Entries that the estimator made by :meth:`make_value_estimator` reads, if there is one."""
        if self._value_estimator is None or self.critic_network is None:
            return []
        keys = self.tensor_keys
        after = [*self.critic_network.in_keys, keys.reward, keys.done, keys.terminated]
        return [("next", *((key,) if isinstance(key, str) else key)) for key in after]

    def _writes(self) -> list[NestedKey]:
        entropy = ["loss_entropy", "entropy"] if self.entropy_bonus else []
        critic = [] if self.critic_network is None else ["loss_critic", "explained_variance"]
        return ["loss_objective", *entropy, *critic]

    def _read_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` reads besides the networks' inputs."""
        keys = self.tensor_keys
        read = [keys.action, keys.sample_log_prob, keys.advantage]
        return read if self.critic_network is None else [*read, keys.value_target, keys.value]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        if self._value_estimator is not None:
            accepted = {field.name for field in fields(self._value_estimator._AcceptedKeys)}
            self._value_estimator.set_keys(**{k: v for k, v in kwargs.items() if k in accepted})


def _under_group(critic: TensorDictModule | None) -> dict[str, NestedKey]:
    """The keys of a critic whose values lie in a group of agents, ``("agents", "state_value")``; none for any other."""
    value = next((key for key in critic.out_keys if key[-1] == "state_value"), None) if critic is not None else None
    if value is None:
        return {}
    return {"value": value, **{name: (*value[:-1], name) for name in ("advantage", "value_target")}}


ActorCriticLoss = PolicyLoss  # its name while the settings of entropy and value had a class of their own
