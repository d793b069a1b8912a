"""What every advantage estimator shares: the critic's values along a rollout, and what is written into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from pgkit.errors import UserError, within
from pgkit.functional import listed
from pgkit.functional import standardize as over_all
from pgkit.functional.modes import in_evaluation

Keys = NestedKey | list[NestedKey]


class Advantage(TensorDictModuleBase):
    """Base of the estimators: writes ``advantage`` and ``value_target`` (``[*B, T, 1]``) into a rollout ``[*B, T]``.

    A subclass says in :meth:`estimate` what they are. In one call, the critic reads every observation, and besides only
    the true final observations of episodes and the rollout's last: elsewhere the next value is the value one step on.

    The critic is read in evaluation mode (no dropout, normalization by running statistics).

    **Many agents**: with a critic that writes ``("agents", "state_value")``, ``[*B, T, agents, 1]``, the results lie
    under the same name and have the same shape. Reward and flags are the group's own where the rollout has them, else
    those at its root, which then count for every agent. :meth:`set_keys` names other entries.

    Where an update compiles and makes few steps a rollout, a ``recordable`` estimator is recorded as tensor operations:
    its settings that change must be buffers, as ``gamma`` is. Set it to False where they cannot be.

    Args:
        critic: value operator, reads the rollout's observation, writes ``state_value``; None: all values are zero.
        gamma: discount; this block owns it.
        standardize: give the advantage zero mean and unit deviation over the whole rollout, all agents together; steps
            that the rollout's ``("collector", "mask")`` or the group's ``mask`` leaves out do not count.
        per_agent: standardize each agent's advantage by itself.
        return_scale: a :class:`~pgkit.modules.ReturnScale`; the critic then works in its unit and so does
            ``value_target``, while ``advantage`` stays in the rewards' unit.
    """

    @dataclass(frozen=True)
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change, with TorchRL's names; of several, those that the rollout has."""

        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        reward: Keys = "reward"
        done: Keys = "done"
        terminated: Keys = "terminated"
        mask: Keys = ("collector", "mask")

    recordable: bool = True
    gamma: Tensor

    def __init__(
        self,
        critic: TensorDictModule | None,
        *,
        gamma: float = 0.99,
        standardize: bool = False,
        per_agent: bool = False,
        return_scale: Any = None,
    ) -> None:
        self._in_keys = self._out_keys_apparent = None
        super().__init__()
        within(0, 1, gamma=gamma)
        name = type(self).__name__
        if critic is not None and not hasattr(critic, "in_keys"):
            raise UserError(f"{name} takes a TensorDict module as critic, this is a {type(critic).__name__}")
        written = [] if critic is None else list(critic.out_keys)
        values = [key for key in written if _path(key)[-1] == "state_value"]
        if critic is not None and len(values) != 1 and len(written) != 1:
            raise UserError(
                f"{name} reads 'state_value' of its critic, this network writes {', '.join(map(str, written))}: give "
                "modules.state_value(env), or a TensorDictModule with out_keys=['state_value']"
            )
        self.critic, self.standardize, self.return_scale = critic, standardize, return_scale
        self.standardizer = over_all  # of several learners, one over the rows of all
        self.per_agent = per_agent
        self._critic_value = (values or written or ["state_value"])[0]
        self.register_buffer("gamma", torch.tensor(float(gamma), dtype=torch.float64))
        self.tensor_keys = self._AcceptedKeys()
        if group := _path(self._critic_value)[:-1]:
            self.tensor_keys = replace(self.tensor_keys, **_under(group))

    def register_buffer(self, name: str, tensor: Tensor | None, persistent: bool = True) -> None:
        """As in torch, on the critic's device: a CUDA graph takes nothing from another."""
        device = next((p.device for p in self.parameters()), None)
        super().register_buffer(name, tensor if tensor is None else tensor.to(device=device), persistent)

    def set_keys(self, **keys: Any) -> None:
        """As in TorchRL: other names for the entries of :attr:`tensor_keys`; of a list, the first that there is.

        Raises:
            UserError: a name that this estimator does not know.
        """
        known = [field.name for field in fields(self.tensor_keys)]
        for name in keys:
            if name not in known:
                raise UserError(f"{type(self).__name__}.set_keys: '{name}' is none of {', '.join(known)}")
        self.tensor_keys = replace(self.tensor_keys, **keys)

    def under_group(self, name: str) -> NestedKey:
        """``name``, below the critic's group if it has one."""
        group = _path(self._critic_value)[:-1]
        return (*group, name) if group else name

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Advantage and value target ``[*B, T, 1]`` of the values :math:`V(s_t)` and :math:`V(s'_t)` of a rollout.

        With agents all of these are ``[*B, agents, T, 1]``: time is the dimension before the last. :meth:`ends` gives
        rewards and flags in the same form.
        """
        raise NotImplementedError(f"{type(self).__name__} has no estimate(): return the advantage and the value target")

    def ends(self, value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """``reward``, ``done`` and ``terminated`` of a rollout's steps, each in the shape of ``value``."""
        keys = (self.tensor_keys.reward, self.tensor_keys.done, self.tensor_keys.terminated)
        reward, done, terminated = (as_values(self._after(key, rollout), value, rollout) for key in keys)
        return reward, done, terminated

    @torch.no_grad()
    def forward(self, rollout: TensorDictBase) -> TensorDictBase:
        """Reads and returns ``rollout``, which has time as its last batch dimension."""
        if not rollout.batch_size.numel():
            raise UserError(f"{type(self).__name__} got an empty rollout {list(rollout.batch_size)}: give it steps")
        keys, time = self.tensor_keys, rollout.batch_dims - 1
        scale = 1.0 if self.return_scale is None else self.return_scale.scale
        if self.critic is None:
            value = next_value = torch.zeros_like(self._after(keys.reward, rollout))
        else:
            with in_evaluation(self.critic):
                value, next_value = self._values(self.critic, rollout)
            rollout.set(keys.value, value)
        values = ((x * scale).movedim(time, -2) for x in (value, next_value))
        advantage, target = (x.movedim(-2, time) for x in self.estimate(*values, rollout))
        if self.standardize:
            advantage = self.standardizer(advantage, self._mask(advantage, rollout), self._axes(advantage, time))
        rollout.set(keys.advantage, advantage)
        rollout.set(keys.value_target, target / scale)
        return rollout

    @property
    def in_keys(self) -> list[NestedKey]:
        """Every entry that it may read; of an entry that may lie in two places, both."""
        return list(dict.fromkeys(self._reads() if self._in_keys is None else self._in_keys))

    @in_keys.setter
    def in_keys(self, keys: Sequence[NestedKey] | None) -> None:
        self._in_keys = keys

    @property
    def out_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Every entry that it writes."""
        return list(self._writes() if self._out_keys_apparent is None else self._out_keys_apparent)

    @out_keys.setter
    def out_keys(self, keys: Sequence[NestedKey] | None) -> None:
        self._out_keys_apparent = keys

    def _reads(self) -> list[NestedKey]:
        keys, observed = self.tensor_keys, [] if self.critic is None else list(self.critic.in_keys)
        after = [*observed, *listed(keys.reward), *listed(keys.done), *listed(keys.terminated)]
        masks = listed(keys.mask) if self.standardize else []
        return [*observed, *(("next", *_path(key)) for key in after), *masks]

    def _writes(self) -> list[NestedKey]:
        keys = self.tensor_keys
        return [keys.advantage, keys.value_target, *([] if self.critic is None else [keys.value])]

    def _after(self, keys: Keys, rollout: TensorDictBase) -> Tensor:
        """The first of the entries ``("next", key)`` that the rollout has."""
        for key in listed(keys):
            if (x := rollout.get(("next", *_path(key)), None)) is not None:
                return x
        raise UserError(
            f"the rollout has no {' and no '.join(str(('next', *_path(key))) for key in listed(keys))}, which "
            f"{type(self).__name__} reads: name the entry, set_keys({_path(listed(keys)[-1])[-1]}=...)"
        )

    def _values(self, critic: TensorDictModule, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Values of all observations and of all next ones, both ``[*B, T, 1]`` or ``[*B, T, agents, 1]``."""
        time, batch = rollout.batch_dims - 1, rollout.batch_size
        own = self._after(self.tensor_keys.done, rollout).flatten(time + 1).any(-1)  # whose successor is not the next
        own[..., -1] = True
        if torch.compiler.is_compiling():  # shapes may not depend on the data: the critic reads all next ones
            both = torch.cat([x.select(*critic.in_keys).reshape(-1) for x in (rollout, rollout["next"])])
            values = critic(both)[self._critic_value]
            value, after = values.reshape(2, *batch, *values.shape[1:])
            following = torch.cat([value.narrow(time, 1, batch[-1] - 1), after.narrow(time, batch[-1] - 1, 1)], time)
            return value, torch.where(own[(..., *[None] * (value.dim() - own.dim()))], after, following)
        rows = rollout.numel()
        both = {key: torch.cat([rollout[key].flatten(0, time), rollout["next"][key][own]]) for key in critic.in_keys}
        values = critic(TensorDict(both))[self._critic_value]
        agents = () if isinstance(self.tensor_keys.value, str) else values.shape[1:2]
        if values.shape[1:] != (*agents, 1):
            raise UserError(
                f"the critic's '{self._critic_value}' is {tuple(values.shape[1:])} for one observation, "
                f"{type(self).__name__} reads one value{' an agent' if agents else ''}, {(*agents, 1)}"
            )
        value = values[:rows].reshape(*batch, *values.shape[1:])
        next_value = torch.cat([value.narrow(time, 1, batch[-1] - 1), torch.zeros_like(value.narrow(time, 0, 1))], time)
        next_value[own] = values[rows:]
        return value, next_value

    def _mask(self, advantage: Tensor, rollout: TensorDictBase) -> Tensor | None:
        """Which elements of the advantage count, in its shape; None: all."""
        masks = [x for key in listed(self.tensor_keys.mask) if (x := rollout.get(key, None)) is not None]
        if not masks:
            return None
        spread = [x.reshape(*x.shape, *[1] * (advantage.dim() - x.dim())).expand_as(advantage) for x in masks]
        return torch.stack(spread).all(0)

    def _axes(self, advantage: Tensor, time: int) -> list[int] | None:
        """Dimensions that are averaged over: all, or all but the agents'."""
        return [*range(time + 1), advantage.dim() - 1] if self.per_agent else None


def as_values(x: Tensor, value: Tensor, rollout: TensorDictBase) -> Tensor:
    """``x [*B, T, 1]`` or ``[*B, T, agents, 1]`` in the form of ``value``: time before the last, for every agent."""
    time = rollout.batch_dims - 1
    if value.dim() == rollout.batch_dims + 1:
        return x
    if x.dim() < value.dim():
        return x.unsqueeze(time).expand(value.shape)
    return x.movedim(time, -2)


def ends(rollout: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
    """``reward``, ``done`` and ``terminated`` of a rollout's steps, each ``[*B, T, 1]``."""
    following = rollout["next"]
    return following["reward"], following["done"], following["terminated"]


def _path(key: NestedKey) -> tuple[Any, ...]:
    return (key,) if isinstance(key, str) else key


def _under(group: tuple[str, ...]) -> dict[str, Keys]:
    """The keys of a group: results under its name; reward and flags there or at the root; two masks."""
    results = {name: (*group, name) for name in ("advantage", "value_target")}
    given = {name: [(*group, name), name] for name in ("reward", "done", "terminated")}
    return {**results, **given, "value": (*group, "state_value"), "mask": [("collector", "mask"), (*group, "mask")]}
