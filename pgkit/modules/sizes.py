"""Sizes of observations and actions, read off an environment's TorchRL specs."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

import torch
from tensordict.utils import NestedKey
from torchrl.data import Bounded, Composite, Stacked, TensorSpec
from torchrl.envs import EnvBase

from pgkit.errors import UserError

LARGEST_BOUND = 1e6  # of an action; beyond it bounds stand for none


def observation_spec(env: Any, key: NestedKey = "observation") -> TensorSpec:
    """Spec of one observation, without the environment's batch dimensions; of a group's entry, of all its agents."""
    spec = _specs(env)
    if key not in spec.keys(True):
        raise UserError(
            f"the environment has no observation '{key}', only {', '.join(map(str, spec.keys(True, True)))}: pass "
            "encoder=modules.dict_encoder({name: module}) with those names"
        )
    return _unbatched(spec[key], len(spec.shape), key)


def action_spec(env: Any, key: NestedKey = "action") -> TensorSpec:
    """Spec of one action, without the environment's batch dimensions; of a group's, of all its agents."""
    dims = len(_specs(env).shape)
    actions = env.full_action_spec if isinstance(env, EnvBase) else env.action_spec
    if key not in actions.keys(True):
        raise UserError(f"the environment has no action '{key}', only {', '.join(map(str, actions.keys(True, True)))}")
    return _unbatched(actions[key], dims, key)


def groups(env: Any) -> list[str]:
    """Names of the groups of agents: those that have an action of their own."""
    actions = env.full_action_spec if isinstance(env, EnvBase) else env.action_spec
    return list(dict.fromkeys(key[0] for key in actions.keys(True, True) if not isinstance(key, str)))


def spec_device(env: Any) -> torch.device | None:
    """Where the environment's tensors live."""
    device = _specs(env).device
    return None if device is None else torch.device(device)


def box_action(spec: TensorSpec, needs_bounds: bool = False) -> TensorSpec:
    """``spec``, which is that of one continuous action; a ``UserError`` names the right builder otherwise."""
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
    if needs_bounds:
        _check_bounds(spec)
    return spec


def _check_bounds(spec: Any) -> None:
    """A ``UserError`` for bounds that no squashed action can have."""
    advice = "use modules.gaussian_actor, or bound the Box"
    if not isinstance(spec, Bounded):
        raise UserError(f"the action space has no bounds to squash into: {advice}")
    space: Any = spec.space
    for i, (low, high) in enumerate(zip(space.low.tolist(), space.high.tolist(), strict=True)):
        if not low < high:
            raise UserError(
                f"action {i} is bounded to [{low:g}, {high:g}], which leaves no choice: take it out of the action space"
            )
        if max(abs(low), abs(high)) > LARGEST_BOUND:
            raise UserError(
                f"action {i} is bounded to [{low:g}, {high:g}], too wide to squash into (at most {LARGEST_BOUND:g} "
                f"from 0): {advice} (gymnasium.wrappers.RescaleAction(env, -1, 1))"
            )


def layer_sizes(hidden: Sequence[int]) -> list[int]:
    """Sizes of hidden layers as a list; a ``UserError`` for a single number."""
    if isinstance(hidden, int):
        raise UserError(f"hidden={hidden}: give the sizes of the layers, hidden=({hidden},) for one")
    return list(hidden)


def flat_size(shape: Sequence[int], key: NestedKey) -> int:
    """Number of features of one flat observation."""
    if len(shape) != 1:
        raise UserError(
            f"observation '{key}' has shape {tuple(shape)}, a perceptron needs a flat one: flatten it in the "
            "environment, or pass encoder= (a module from that shape to features, modules.conv_encoder(env) for "
            "images) to a builder that takes one"
        )
    return prod(shape)


def _specs(env: Any) -> Composite:
    spec = getattr(env, "observation_spec", None)
    if not isinstance(spec, Composite):
        raise UserError(
            f"sizes are read off a TorchRL environment, this is a {type(env).__name__}: give envs.make(...)"
        )
    return spec


def _unbatched(spec: Any, dims: int, key: NestedKey) -> TensorSpec:
    if isinstance(spec, Stacked):
        raise UserError(
            f"the agents of group '{key[0]}' have different spaces, one network needs equal ones: put them into "
            "groups of their own (group_map= of TorchRL's environments), and build a network for each"
        )
    for _ in range(dims):
        spec = spec[0]
    return spec
