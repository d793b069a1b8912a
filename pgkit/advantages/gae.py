"""Generalized advantage estimation over a rollout."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from pgkit.functional import generalized_advantage


class GAE(TensorDictModuleBase):
    """Writes ``advantage``, ``value_target`` and ``state_value`` (``[*B, T, 1]``) into a rollout ``[*B, T]``.

    Schulman et al., 2016 (https://arxiv.org/abs/1506.02438). In one call, the critic reads every observation, and
    besides only on the true final observations of episodes and the rollout's last: elsewhere the next value is the
    value one step on. This block owns gamma and lambda.

    Args:
        critic: value operator, reads the rollout's observation, writes ``state_value``.
        gamma: discount.
        lmbda: GAE's lambda.
        average_gae: standardize the advantage over the whole rollout (TorchRL's keyword).
        return_scale: a :class:`~pgkit.modules.ReturnScale`; the critic then works in its unit and so does
            ``value_target``, while ``advantage`` stays in the rewards' unit.
    """

    gamma: Tensor
    lmbda: Tensor

    def __init__(
        self,
        critic: TensorDictModule,
        *,
        gamma: float = 0.99,
        lmbda: float = 0.95,
        average_gae: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__()
        self.critic, self.average_gae, self.return_scale = critic, average_gae, return_scale
        self.register_buffer("gamma", torch.tensor(float(gamma)))
        self.register_buffer("lmbda", torch.tensor(float(lmbda)))
        following = ["reward", "done", "terminated"]
        self.in_keys = [*critic.in_keys, *[("next", key) for key in [*critic.in_keys, *following]]]
        self.out_keys = ["advantage", "value_target", "state_value"]

    @torch.no_grad()
    def forward(self, rollout: TensorDictBase) -> TensorDictBase:
        """Reads and returns ``rollout``, which has time as its last batch dimension."""
        reward, done, terminated = (rollout["next", key] for key in ("reward", "done", "terminated"))
        own = done.squeeze(-1).clone()  # steps whose successor is not the next entry
        own[..., -1] = True
        value, final = self._values(rollout, own)
        next_value = torch.cat([value[..., 1:, :], torch.zeros_like(value[..., :1, :])], -2)
        next_value[own] = final
        scale = 1.0 if self.return_scale is None else self.return_scale.scale
        advantage, target = generalized_advantage(
            value * scale, next_value * scale, reward, done, terminated, self.gamma, self.lmbda
        )
        if self.average_gae:
            advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
        rollout.set("advantage", advantage)
        rollout.set("value_target", target / scale)
        rollout.set("state_value", value)
        return rollout

    def _values(self, rollout: TensorDictBase, own: Tensor) -> tuple[Tensor, Tensor]:
        """Values of all observations ``[*B, T, 1]``, and of the next ones where ``own`` ``[own.sum(), 1]``."""
        rows, dims = rollout.numel(), rollout.batch_dims
        keys = self.critic.in_keys
        both = {key: torch.cat([rollout[key].flatten(0, dims - 1), rollout["next"][key][own]]) for key in keys}
        values = self.critic(TensorDict(both))[self.critic.out_keys[0]]
        return values[:rows].reshape(*rollout.batch_size, 1), values[rows:]
