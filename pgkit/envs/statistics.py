"""Wrappers and transforms that keep statistics, which evaluation and a resume begin anew."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorWrapper
from gymnasium.wrappers import vector as vector_wrappers
from torchrl.envs import Compose, TransformedEnv, VecNorm, VecNormV2

from pgkit.envs.once import warn_once

_STATISTICS = (
    gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward, vector_wrappers.NormalizeObservation,
    vector_wrappers.NormalizeReward,
)  # fmt: skip


def warn_of_statistics(env: Any) -> None:
    """Says that a wrapper's statistics are its own: a resume and an evaluation begin with none."""
    while isinstance(env, gym.Wrapper | VectorWrapper):
        if isinstance(env, _STATISTICS):
            _say_statistics(env)
        env = env.env
    if isinstance(env, TransformedEnv):
        for transform in env.transform if isinstance(env.transform, Compose) else [env.transform]:
            if isinstance(transform, VecNorm | VecNormV2):
                _say_statistics(transform)


def _say_statistics(owner: Any) -> None:
    warn_once(
        f"{type(owner).__name__} keeps statistics that evaluation and a resume begin anew: use --normalize-obs "
        "(modules.ObsNormalizer) and --scale-returns, which are part of the checkpoint"
    )
