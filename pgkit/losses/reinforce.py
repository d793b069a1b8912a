"""REINFORCE (Williams, 1992, https://doi.org/10.1007/BF00992696), with or without a learned baseline."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey

from pgkit.functional import policy_gradient
from pgkit.functional.values import Distance
from pgkit.losses.policy_base import PolicyLoss


class ReinforceLoss(PolicyLoss):
    r"""REINFORCE, a drop-in for TorchRL's loss of that name.

    .. math::
        L = -\frac1B \sum \log \pi(a|s)\, A + \frac1B \sum (V - V^{target})^2

    :math:`A` is a return, minus a baseline if there is one: see :class:`pgkit.advantages.MonteCarlo`. Differs from
    TorchRL's: squared error for the value (there ``smooth_l1``), and the critic may be None.

    Args:
        actor_network: probabilistic actor.
        critic_network: the baseline; None: there is none.
        loss_critic_type, clip_value, separate_losses, reduction: as in :class:`~pgkit.losses.PolicyLoss`.

    Writes ``loss_actor``, ``loss_value`` and the metric ``explained_variance``.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule | None = None,
        *,
        loss_critic_type: str | Distance = "l2",
        clip_value: float | None = None,
        separate_losses: bool = False,
        reduction: str | None = None,
    ) -> None:
        super().__init__(
            actor_network, critic_network, loss_critic_type=loss_critic_type, clip_value=clip_value,
            entropy_bonus=False, separate_losses=separate_losses, reduction=reduction,
        )  # fmt: skip

    def _read_keys(self) -> list[NestedKey]:
        return [key for key in super()._read_keys() if key != self.tensor_keys.sample_log_prob]

    def _writes(self) -> list[NestedKey]:
        return ["loss_actor", *([] if self.critic_network is None else ["loss_value", "explained_variance"])]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of a batch ``[*B]`` with ``advantage`` ``[*B, 1]``."""
        batch = tensordict.copy()
        advantage, dist = self.get_advantage(batch), self.distribution(batch)
        objective = policy_gradient(self.log_prob(dist, batch).unsqueeze(-1), advantage)

        out = TensorDict({"loss_actor": self.reduce(-objective, batch)})
        self.add_critic(out, batch, "loss_value")
        return out
