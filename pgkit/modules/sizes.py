"""Sizes of observations and actions, read off an environment's TorchRL specs."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import torch
from tensordict.utils import NestedKey
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase

from pgkit.errors import UserError


def observation_shape(env: EnvBase, key: NestedKey = "observation") -> torch.Size:
    """Shape of one observation, without the environment's batch dimensions."""
    _check(env)
    spec = env.observation_spec_unbatched
    if key not in spec.keys(True):
        raise UserError(
            f"the environment has no observation '{key}', only {', '.join(map(str, spec.keys()))}: pass encoder="
            "modules.dict_encoder({name: module}) with those names"
        )
    return spec[key].shape


def observation_size(env: EnvBase, key: str = "observation") -> int:
    """Number of features of one flat observation."""
    shape = observation_shape(env, key)
    if len(shape) != 1:
        raise UserError(
            f"observation '{key}' has shape {tuple(shape)}, a perceptron needs a flat one: flatten it in the "
            "environment, or pass encoder= (a module from that shape to features) to a builder that takes one"
        )
    return shape[0]


def box_action(env: EnvBase, needs_bounds: bool = False) -> TensorSpec:
    """Spec of one continuous action; a ``UserError`` names the right builder otherwise."""
    _check(env)
    spec = env.action_spec_unbatched
    if not spec.dtype.is_floating_point:
        raise UserError(
            f"the action space is discrete ({spec.__class__.__name__}): use modules.categorical_actor and "
            "modules.discrete_q_value; the recipes for it are discrete_sac, dqn, rainbow and ppo"
        )
    if len(spec.shape) != 1:
        raise UserError(
            f"actions have shape {tuple(spec.shape)}, the actors here write flat ones: flatten them in the environment "
            "(gymnasium.wrappers.TransformAction)"
        )
    if needs_bounds and not isinstance(spec, Bounded):
        raise UserError("the action space has no bounds to squash into: use modules.gaussian_actor, or bound the Box")
    return spec


def action_size(env: EnvBase) -> int:
    """Number of dimensions of one continuous action."""
    return prod(box_action(env).shape)


def layer_sizes(hidden: Sequence[int]) -> list[int]:
    """Sizes of hidden layers as a list; a ``UserError`` for a single number."""
    if isinstance(hidden, int):
        raise UserError(f"hidden={hidden}: give the sizes of the layers, hidden=({hidden},) for one")
    return list(hidden)


def _check(env: EnvBase) -> None:
    if not isinstance(env, EnvBase):
        raise UserError(
            f"sizes are read off a TorchRL environment, this is a {type(env).__name__}: give envs.make(...)"
        )
