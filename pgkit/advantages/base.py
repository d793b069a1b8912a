"""What every advantage estimator shares: the critic's values along a rollout, and what is written into it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from pgkit.errors import UserError, within
from pgkit.functional import standardize


class Advantage(TensorDictModuleBase):
    """Base of the estimators: writes ``advantage`` and ``value_target`` (``[*B, T, 1]``) into a rollout ``[*B, T]``.

    A subclass says in :meth:`estimate` what they are. In one call, the critic reads every observation, and besides only
    the true final observations of episodes and the rollout's last: elsewhere the next value is the value one step on.

    Where an update compiles and makes few steps a rollout, a ``recordable`` estimator is recorded as tensor operations:
    its settings that change must be buffers, as ``gamma`` is. Set it to False where they cannot be.

    Args:
        critic: value operator, reads the rollout's observation, writes ``state_value``; None: all values are zero.
        gamma: discount; this block owns it.
        standardize: give the advantage zero mean and unit deviation over the whole rollout.
        return_scale: a :class:`~pgkit.modules.ReturnScale`; the critic then works in its unit and so does
            ``value_target``, while ``advantage`` stays in the rewards' unit.
    """

    recordable: bool = True
    gamma: Tensor

    def __init__(
        self,
        critic: TensorDictModule | None,
        *,
        gamma: float = 0.99,
        standardize: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__()
        within(0, 1, gamma=gamma)
        if critic is not None and not hasattr(critic, "in_keys"):
            raise UserError(
                f"{type(self).__name__} takes a TensorDict module as critic, this is a {type(critic).__name__}"
            )
        if critic is not None and "state_value" not in critic.out_keys and len(critic.out_keys) != 1:
            raise UserError(
                f"{type(self).__name__} reads 'state_value' of its critic, this network writes "
                f"{', '.join(map(str, critic.out_keys))}: give modules.state_value(env), or a TensorDictModule with "
                "out_keys=['state_value']"
            )
        self.critic, self.standardize, self.return_scale = critic, standardize, return_scale
        self.register_buffer("gamma", torch.tensor(float(gamma)))
        observed = [] if critic is None else critic.in_keys
        self.in_keys = [*observed, *[("next", key) for key in [*observed, "reward", "done", "terminated"]]]
        self.out_keys = ["advantage", "value_target", *([] if critic is None else ["state_value"])]

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Advantage and value target ``[*B, T, 1]`` of the values :math:`V(s_t)` and :math:`V(s'_t)` of a rollout."""
        raise NotImplementedError(f"{type(self).__name__} has no estimate(): return the advantage and the value target")

    @torch.no_grad()
    def forward(self, rollout: TensorDictBase) -> TensorDictBase:
        """Reads and returns ``rollout``, which has time as its last batch dimension."""
        scale = 1.0 if self.return_scale is None else self.return_scale.scale
        if self.critic is None:
            value = next_value = torch.zeros_like(rollout["next", "reward"])
        else:
            value, next_value = self._values(self.critic, rollout)
            rollout.set("state_value", value)
        advantage, target = self.estimate(value * scale, next_value * scale, rollout)
        if self.standardize:
            advantage = standardize(advantage)
        rollout.set("advantage", advantage)
        rollout.set("value_target", target / scale)
        return rollout

    def _values(self, critic: TensorDictModule, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Values of all observations and of all next ones, both ``[*B, T, 1]``."""
        own = rollout["next", "done"].squeeze(-1).clone()  # steps whose successor is not the next entry
        own[..., -1] = True
        name = "state_value" if "state_value" in critic.out_keys else critic.out_keys[0]
        if torch.compiler.is_compiling():  # shapes may not depend on the data: the critic reads all next ones
            both = torch.cat([x.select(*critic.in_keys).reshape(-1) for x in (rollout, rollout["next"])])
            value, after = critic(both)[name].reshape(2, *rollout.batch_size, 1)
            return value, torch.where(own.unsqueeze(-1), after, torch.cat([value[..., 1:, :], after[..., -1:, :]], -2))
        rows, dims = rollout.numel(), rollout.batch_dims
        both = {
            key: torch.cat([rollout[key].flatten(0, dims - 1), rollout["next"][key][own]]) for key in critic.in_keys
        }
        values = critic(TensorDict(both))[name]
        if values.shape[1:] != (1,):
            raise UserError(
                f"the critic's '{name}' is {tuple(values.shape[1:])} for one observation, {type(self).__name__} reads "
                "one value, (1,)"
            )
        value = values[:rows].reshape(*rollout.batch_size, 1)
        next_value = torch.cat([value[..., 1:, :], torch.zeros_like(value[..., :1, :])], -2)
        next_value[own] = values[rows:]
        return value, next_value


def ends(rollout: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
    """``reward``, ``done`` and ``terminated`` of a rollout's steps, each ``[*B, T, 1]``."""
    following = rollout["next"]
    return following["reward"], following["done"], following["terminated"]
