"""Actors: observation in, action and its log-probability out, as TorchRL's ``ProbabilisticActor``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal

from pgkit.modules.mlp import orthogonal
from pgkit.modules.sizes import action_size, box_action
from pgkit.modules.trunk import headed, trunk


def gaussian_actor(
    env: EnvBase,
    hidden: Sequence[int] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    *,
    log_std: float = -0.5,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
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
    """
    layers, features = trunk(env, hidden, activation, normalizer, encoder)
    head = GaussianHead(features, action_size(env), log_std)
    return probabilistic(headed(layers, head, ["loc", "scale"]), ["loc", "scale"], IndependentNormal)


def tanh_normal_actor(
    env: EnvBase,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    *,
    log_std_bounds: tuple[float, float] = (-5.0, 2.0),
    tanh_loc: bool = False,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
) -> ProbabilisticActor:
    """A Gaussian squashed by tanh into the action's bounds, mean and standard deviation both of the state (SAC's).

    Sample and log-probability come from one draw (TorchRL's ``rsample_and_log_prob``); a saturated action that is
    scored again later gives a wrong number, so PPO wants ``tanh_loc=True``, which bounds the mean to [-5, 5] before
    the tanh, together with ``log_std_bounds`` whose upper end is at most -1.

    Args:
        env: any TorchRL environment with a bounded continuous action.
        log_std_bounds: the log standard deviation is squashed into this range.
        tanh_loc: bound the mean before the tanh.
        hidden, activation, normalizer, encoder: as in :func:`gaussian_actor`.
    """
    space: Any = box_action(env, needs_bounds=True).space
    layers, features = trunk(env, hidden, activation, normalizer, encoder)
    head = StateDependentHead(features, action_size(env), log_std_bounds, loc_bound=5.0 if tanh_loc else None)
    kwargs = {
        "low": space.low,
        "high": space.high,
        "event_dims": 1,
    }  # its own tanh_loc moves the mean by the bounds' middle
    return probabilistic(headed(layers, head, ["loc", "scale"]), ["loc", "scale"], TanhNormal, kwargs)


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
) -> ProbabilisticActor:
    """An actor with any distribution over a continuous action, whose parameters are raw outputs of one linear head.

    Args:
        env: any TorchRL environment with a continuous action.
        distribution: called as ``distribution(**parameters, **distribution_kwargs)``; its event is one action,
            ``[actions]``. It brings raw numbers into the range it needs, and has ``deterministic_sample``, or a
            mean, for evaluation.
        parameters: names, each of the action's size; or a mapping from names to shapes of one state's parameters.
        distribution_kwargs: settings that do not depend on the state.
        hidden, activation, normalizer, encoder: as in :func:`gaussian_actor`.
    """
    size = action_size(env)
    shapes = parameters if isinstance(parameters, Mapping) else {name: (size,) for name in parameters}
    layers, features = trunk(env, hidden, activation, normalizer, encoder)
    net = headed(layers, SplitHead(features, list(shapes.values())), list(shapes))
    return probabilistic(net, list(shapes), distribution, dict(distribution_kwargs or {}))


class GaussianHead(nn.Module):
    """Linear mean and a state-independent ``log_std`` parameter: ``[*B, features] -> 2 x [*B, actions]``."""

    def __init__(self, features: int, actions: int, log_std: float) -> None:
        super().__init__()
        self.mean = orthogonal(nn.Linear(features, actions), 0.01)
        self.log_std = nn.Parameter(torch.full((actions,), float(log_std)))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        loc = self.mean(x)
        return loc, self.log_std.exp().expand_as(loc)


class StateDependentHead(nn.Module):
    """Linear mean and log standard deviation within bounds: ``[*B, features] -> 2 x [*B, actions]``."""

    def __init__(
        self, features: int, actions: int, log_std_bounds: tuple[float, float], loc_bound: float | None = None
    ) -> None:
        super().__init__()
        self.linear = nn.Linear(features, 2 * actions)
        (self.low, self.high), self.loc_bound = log_std_bounds, loc_bound

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        loc, raw = self.linear(x).chunk(2, -1)
        loc = loc if self.loc_bound is None else self.loc_bound * (loc / self.loc_bound).tanh()
        return loc, (self.low + 0.5 * (self.high - self.low) * (raw.tanh() + 1)).exp()


class SplitHead(nn.Module):
    """One linear layer whose output is cut into several: ``[*B, features] -> [*B, *shape]`` for each shape."""

    def __init__(self, features: int, shapes: Sequence[Sequence[int]]) -> None:
        super().__init__()
        self.shapes = [tuple(shape) for shape in shapes]
        self.linear = orthogonal(nn.Linear(features, sum(map(prod, self.shapes))), 0.01)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        parts = self.linear(x).split([prod(shape) for shape in self.shapes], -1)
        return tuple(part.unflatten(-1, shape) for part, shape in zip(parts, self.shapes, strict=True))


def probabilistic(
    net: TensorDictModule,
    parameters: Sequence[str],
    distribution: Callable[..., Distribution],
    kwargs: dict[str, Any] | None = None,
) -> ProbabilisticActor:
    """TorchRL's ``ProbabilisticActor`` of a network that writes the distribution's parameters."""
    return ProbabilisticActor(
        net,
        in_keys=[*parameters],
        distribution_class=distribution,
        distribution_kwargs=kwargs or {},
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )
