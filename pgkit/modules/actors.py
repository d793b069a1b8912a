"""Actors: observation in, action and its log-probability out, as TorchRL's ``ProbabilisticActor``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal, OneHotCategorical, ProbabilisticActor, TanhNormal

from pgkit.errors import UserError
from pgkit.modules.mlp import orthogonal
from pgkit.modules.sizes import action_size, box_action
from pgkit.modules.trunk import trunk


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
        encoder: replaces the hidden layers; its output feeds the head. Give the same one to
            :func:`~pgkit.modules.state_value` to share it.
    """
    layers, features = trunk(env, hidden, activation, normalizer, encoder)
    head = GaussianHead(features, action_size(env), log_std)
    return _actor(nn.Sequential(*layers, head), ["loc", "scale"], IndependentNormal, env)


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
    head = StateDependentHead(features, action_size(env), log_std_bounds)
    kwargs = {"low": space.low, "high": space.high, "tanh_loc": tanh_loc, "event_dims": 1}
    return _actor(nn.Sequential(*layers, head), ["loc", "scale"], TanhNormal, env, kwargs)


def categorical_actor(
    env: EnvBase,
    hidden: Sequence[int] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    *,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
) -> ProbabilisticActor:
    """A categorical distribution over discrete actions.

    The action is an index where the spec is TorchRL's ``Categorical`` (pgkit's environments), one-hot where it is
    ``OneHot`` (TorchRL's ``GymEnv`` by default). Arguments as in :func:`gaussian_actor`.
    """
    spec: Any = env.action_spec_unbatched
    if spec.dtype.is_floating_point or not hasattr(spec.space, "n"):
        raise UserError(
            f"categorical_actor needs a discrete action, the environment's is {spec.__class__.__name__}: "
            "use modules.gaussian_actor or modules.tanh_normal_actor"
        )
    layers, features = trunk(env, hidden, activation, normalizer, encoder)
    head = orthogonal(nn.Linear(features, spec.space.n), 0.01)
    distribution = OneHotCategorical if spec.shape else Categorical
    return _actor(nn.Sequential(*layers, head), ["logits"], distribution, env)


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
    """Linear mean and log standard deviation, the latter within bounds: ``[*B, features] -> 2 x [*B, actions]``."""

    def __init__(self, features: int, actions: int, log_std_bounds: tuple[float, float]) -> None:
        super().__init__()
        self.linear = nn.Linear(features, 2 * actions)
        self.low, self.high = log_std_bounds

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        loc, raw = self.linear(x).chunk(2, -1)
        return loc, (self.low + 0.5 * (self.high - self.low) * (raw.tanh() + 1)).exp()


def _actor(
    net: nn.Module,
    parameters: list[str],
    distribution: type,
    env: EnvBase,
    kwargs: dict[str, Any] | None = None,
) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=parameters),
        in_keys=parameters,
        distribution_class=distribution,
        distribution_kwargs=kwargs or {},
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )
