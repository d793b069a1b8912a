"""What the losses of an actor and its critic share besides the policy's own term: entropy and value."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution

from pgkit.functional import clipped_value_loss, explained_variance, standardize, value_loss
from pgkit.functional.values import Distance
from pgkit.losses.policy_base import PolicyLoss


class ActorCriticLoss(PolicyLoss):
    """Base of A2C, PPO and TRPO: a :class:`~pgkit.losses.PolicyLoss` with TorchRL's settings of entropy and value.

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
        separate_losses: parameters shared by actor and critic are trained by the policy's loss only.
        reduction: ``mean``, ``sum`` or ``none``.
    """

    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset({"entropy_coeff", "critic_coeff", "clip_value"})

    entropy_coeff: Tensor
    critic_coeff: Tensor
    clip_value: Tensor | None

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
        critic = critic_network if critic_coeff else None
        super().__init__(actor_network, critic, separate_losses=separate_losses, reduction=reduction)
        self.register_coeff_buffer("entropy_coeff", entropy_coeff)
        self.register_coeff_buffer("critic_coeff", critic_coeff)
        self.register_coeff_buffer("clip_value", clip_value)
        self.loss_critic_type, self.normalize_advantage = loss_critic_type, normalize_advantage
        self.entropy_bonus, self.samples_mc_entropy = entropy_bonus, samples_mc_entropy

    def get_advantage(self, batch: TensorDictBase) -> Tensor:
        """The batch's advantage ``[*B, 1]``, standardized over the batch if this loss does that."""
        advantage = super().get_advantage(batch)
        return standardize(advantage, self.mask(advantage, batch)) if self.normalize_advantage else advantage

    @staticmethod
    def mask(entry: Tensor, batch: TensorDictBase) -> Tensor | None:
        """Which elements of an entry ``[*B, 1]`` are no padding, in its shape; None if the batch has none."""
        mask = batch.get(("collector", "mask"), None)
        return None if mask is None else mask.reshape(entry.shape)

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
        value, target = self.value(batch), batch[self.tensor_keys.value_target]
        if self.clip_value is None:
            error = value_loss(value, target, self.loss_critic_type)
        else:
            old_value = batch[self.tensor_keys.value]
            error = clipped_value_loss(value, target, old_value, self.clip_value, self.loss_critic_type)
        out[name] = self.reduce(self.critic_coeff * error, batch)
        out["explained_variance"] = explained_variance(value.detach(), target, self.mask(target, batch))

    def _writes(self) -> list[NestedKey]:
        entropy = ["loss_entropy", "entropy"] if self.entropy_bonus else []
        critic = [] if self.critic_network is None else ["loss_critic", "explained_variance"]
        return [*entropy, *critic]
