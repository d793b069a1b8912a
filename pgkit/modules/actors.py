"""Actors: observation in, action and its log-probability out, as TorchRL's ``ProbabilisticActor``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any, cast

import torch
from tensordict.nn import InteractionType
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal

from pgkit.modules.groups import Agents, Share, agents
from pgkit.modules.sizes import box_action
from pgkit.modules.trunk import Trunk, headed, trunk


def gaussian_actor(
    env: EnvBase,
    hidden: Sequence[int] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    *,
    log_std: float = -0.5,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """A Gaussian whose mean depends on the state and whose standard deviation is one free parameter a dimension.

    The action is unbounded; pgkit's environments clip it to their bounds, the rollout keeps it as sampled.

    Args:
        env: any TorchRL environment with a continuous action; sizes come from its specs.
        hidden: sizes of the hidden layers.
        activation: class of the activation.
        log_std: initial log standard deviation (-0.5 explores less than CleanRL's 0 and learns faster on MuJoCo).
        normalizer: applied to the observation first, e.g. :class:`~pgkit.modules.ObsNormalizer`.
        encoder: replaces the hidden layers; its output feeds the head. It is called with the observation, or with the
            entries that its attribute ``in_keys`` names (:func:`~pgkit.modules.dict_encoder`). Give the same one
            to :func:`~pgkit.modules.state_value` to share it.
        group: of many agents, the group whose actions these are (``("agents", "action") [*B, agents, actions]``); found
            by itself if it is the only one.
        share_parameters: True: one set of parameters for all agents; False: one for each; or the number of each agent's
            set, as a sequence or a mapping.
        agent_ids: let the network know each agent's number, as a one-hot.
        device: where the network is built, by default the specs' device; a module that is handed in stays where it is.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    body = trunk(who, hidden, activation, normalizer, encoder)
    head = GaussianHead(who, body.features, box_action(who.action()).shape[0], log_std)
    return probabilistic(who, body, head, ["loc", "scale"], IndependentNormal)


def tanh_normal_actor(
    env: EnvBase,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    *,
    log_std_bounds: tuple[float, float] = (-5.0, 2.0),
    tanh_loc: bool = False,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """SAC's Gaussian, squashed by tanh into the action's bounds; mean and standard deviation depend on the state.

    Sample and log-probability come from one draw (TorchRL's ``rsample_and_log_prob``), since a saturated action that is
    scored again later gives a wrong number. PPO scores actions again: use ``tanh_loc=True``, which bounds the mean to
    [-5, 5] before the tanh, and ``log_std_bounds`` whose upper end is at most -1.

    Args:
        env: any TorchRL environment with a bounded continuous action.
        log_std_bounds: the log standard deviation is squashed into this range.
        tanh_loc: bound the mean before the tanh.
        hidden, activation, normalizer, encoder, group, share_parameters, agent_ids, device: as in
            :func:`gaussian_actor`.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    spec = box_action(who.action(), needs_bounds=True)
    body, space = trunk(who, hidden, activation, normalizer, encoder), cast(Any, spec.space)
    linear = who.linear(body.features, 2 * spec.shape[0])
    head = StateDependentHead(linear, log_std_bounds, loc_bound=5.0 if tanh_loc else None)
    device = next(linear.parameters()).device
    kwargs = {
        "low": space.low.to(device),
        "high": space.high.to(device),
        "event_dims": 1,
    }  # its own tanh_loc moves the mean by the bounds' middle
    return probabilistic(who, body, head, ["loc", "scale"], TanhNormal, kwargs)


def actor(
    env: EnvBase,
    distribution: Callable[..., Distribution],
    parameters: Sequence[str] | Mapping[str, Sequence[int]] = ("loc", "scale"),
    hidden: Sequence[int] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    *,
    distribution_kwargs: Mapping[str, Any] | None = None,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """An actor with any distribution over a continuous action, whose parameters are raw outputs of one linear head.

    Args:
        env: any TorchRL environment with a continuous action.
        distribution: called as ``distribution(**parameters, **distribution_kwargs)``; its event is one action,
            ``[actions]``. It brings raw numbers into the range it needs, and has ``deterministic_sample``, or a
            mean, for evaluation.
        parameters: names, each of the action's size; or a mapping from names to shapes of one state's parameters.
        distribution_kwargs: settings that do not depend on the state.
        hidden, activation, normalizer, encoder, group, share_parameters, agent_ids, device: as in
            :func:`gaussian_actor`.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    size = box_action(who.action()).shape[0]
    shapes = parameters if isinstance(parameters, Mapping) else {name: (size,) for name in parameters}
    body = trunk(who, hidden, activation, normalizer, encoder)
    head = SplitHead(who, body.features, list(shapes.values()))
    return probabilistic(who, body, head, list(shapes), distribution, dict(distribution_kwargs or {}))


class Actor(ProbabilisticActor):
    """TorchRL's, whose distribution has its bounds where the weights are: it would copy them there in every call."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Actor:
        super()._apply(fn, recurse)
        settings = self[-1].distribution_kwargs
        settings.update({name: fn(x) for name, x in settings.items() if isinstance(x, Tensor)})
        return self


class GaussianHead(nn.Module):
    """Linear mean and a state-independent ``log_std`` parameter: ``[*B, features] -> 2 x [*B, actions]``.

    ``log_std`` is ``[actions]``; of a group with several sets of parameters, ``[sets, actions]``.
    """

    def __init__(self, who: Agents, features: int, actions: int, log_std: float) -> None:
        super().__init__()
        self.mean = who.linear(features, actions, 0.01)
        self.sets = list(who.sets) if who.several else None
        shape = (max(who.sets) + 1, actions) if who.several else (actions,)
        self.log_std = nn.Parameter(torch.full(shape, float(log_std), device=who.device))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        loc, scale = self.mean(x), self.log_std.exp()
        scale = scale if self.sets is None else torch.stack([scale[i] for i in self.sets])
        return loc, scale.expand_as(loc)


class StateDependentHead(nn.Module):
    """Mean and log standard deviation within bounds: ``[*B, features] -> 2 x [*B, actions]``.

    Args:
        linear: ``[*B, features] -> [*B, 2 * actions]``.
        log_std_bounds: the log standard deviation is squashed into this range.
        loc_bound: the mean is squashed into minus this to this.
    """

    def __init__(self, linear: nn.Module, log_std_bounds: tuple[float, float], loc_bound: float | None = None) -> None:
        super().__init__()
        self.linear = linear
        (self.low, self.high), self.loc_bound = log_std_bounds, loc_bound

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        loc, raw = self.linear(x).chunk(2, -1)
        loc = loc if self.loc_bound is None else self.loc_bound * (loc / self.loc_bound).tanh()
        return loc, (self.low + 0.5 * (self.high - self.low) * (raw.tanh() + 1)).exp()


class SplitHead(nn.Module):
    """One linear layer whose output is cut into several: ``[*B, features] -> [*B, *shape]`` for each shape."""

    def __init__(self, who: Agents, features: int, shapes: Sequence[Sequence[int]]) -> None:
        super().__init__()
        self.shapes = [tuple(shape) for shape in shapes]
        self.linear = who.linear(features, sum(map(prod, self.shapes)), 0.01)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        parts = self.linear(x).split([prod(shape) for shape in self.shapes], -1)
        return tuple(part.unflatten(-1, shape) for part, shape in zip(parts, self.shapes, strict=True))


def probabilistic(
    who: Agents,
    body: Trunk,
    head: nn.Module,
    parameters: Sequence[str],
    distribution: Callable[..., Distribution],
    kwargs: dict[str, Any] | None = None,
    head_keys: Sequence[NestedKey] = (),
) -> ProbabilisticActor:
    """TorchRL's ``ProbabilisticActor`` of a network that writes the distribution's parameters."""
    keys = [who.key(name) for name in parameters]
    return Actor(
        headed(body, head, keys, head_keys),
        in_keys=keys,
        out_keys=None if who.name is None else [who.key("action")],
        distribution_class=distribution,
        distribution_kwargs=kwargs or {},
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )
