"""What a loss asks of the actor and of the action's spec that it is given."""

from __future__ import annotations

from functools import partial
from typing import Any

from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from tensordict.utils import NestedKey
from torch.distributions import Distribution
from torchrl.data import Composite, TensorSpec
from torchrl.modules import Delta, TanhDelta
from torchrl.modules.tensordict_module import SafeProbabilisticTensorDictSequential

from pgkit.errors import UserError

PROBABILISTIC = (ProbabilisticTensorDictSequential, ProbabilisticTensorDictModule)
"""The classes of an actor that draws from a distribution."""


def need_distribution(loss: str, actor: TensorDictModule, builders: str) -> None:
    """Raises ``UserError`` unless the actor draws from a distribution, as those of ``builders`` do."""
    if not isinstance(actor, PROBABILISTIC):
        raise UserError(
            f"{loss} needs an actor that draws from a distribution ({builders}), this one gives one action: "
            "losses.TD3Loss and losses.DDPGLoss take it"
        )


def refuse_stochastic(loss: str, actor: TensorDictModule) -> None:
    """Raises ``UserError`` for an actor that draws its actions from a distribution."""
    if any(not issubclass(kind, Delta | TanhDelta) for kind in _kinds(actor)):
        raise UserError(
            f"{loss} needs an actor that gives one action, this one draws it from a distribution: use "
            "modules.deterministic_actor, or losses.SACLoss for this actor"
        )


def need_kind(loss: str, actor: TensorDictModule, discrete: bool) -> None:
    """Raises ``UserError`` unless the actor's action is one discrete choice, or continuous."""
    for kind in _kinds(actor):
        if kind is CompositeDistribution:
            continue
        if discrete and not kind.has_rsample and not hasattr(kind, "logits"):
            raise UserError(
                f"{loss} takes one discrete action, this actor draws {kind.__name__} ones: losses.ClipPPOLoss and "
                "losses.A2CLoss take it"
            )
        if discrete and kind.has_rsample:
            raise UserError(
                f"{loss} needs an actor over discrete actions, this one is {kind.__name__}: use "
                "modules.categorical_actor, or losses.SACLoss for this actor"
            )
        if not discrete and not kind.has_rsample:
            raise UserError(
                f"{loss} needs an actor over continuous actions, this one is {kind.__name__}: use "
                "modules.tanh_normal_actor, or for discrete actions modules.categorical_actor with "
                "losses.DiscreteSACLoss or losses.ClipPPOLoss"
            )


def action_spec_of(actor: TensorDictModule, key: NestedKey, given: TensorSpec | None) -> Any:
    """Spec of the action ``key``: ``given``, an environment's composite one included, or the actor's own, or None."""
    if given is None and isinstance(actor, SafeProbabilisticTensorDictSequential):
        given = actor.spec
    return given[key] if isinstance(given, Composite) else given


def dimensions(spec: TensorSpec) -> int:
    """Number of dimensions of one action, of a vector's actions ``[num_envs, actions]`` too, or of a composite one."""
    if isinstance(spec, Composite):
        return sum(dimensions(part) for part in spec.values())
    return spec.shape[-1:].numel()


def _kinds(actor: TensorDictModule) -> list[type[Distribution]]:
    """Classes of the actor's distributions."""
    stages = [module for module in actor.modules() if isinstance(module, ProbabilisticTensorDictModule)]
    made = [stage.distribution_class for stage in stages]
    kinds = [kind.func if isinstance(kind, partial) else kind for kind in made]
    return [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Distribution)]
