"""What an environment's resets and steps return, against Gymnasium's interface and its own spaces."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from pgkit.errors import UserError

# the usual types of flags and rewards, which need no look
FLAGS = {bool, np.bool_}
NUMBERS = {float, int, np.float64, np.float32, np.int64}


def checked_reset(env: gym.Env, seed: int) -> tuple[Any, dict[str, Any]]:
    """``env.reset(seed=seed)``; a ``UserError`` where it is not as Gymnasium asks."""
    try:
        result: Any = env.reset(seed=seed)
    except TypeError as error:
        if "seed" not in str(error):
            raise
        raise UserError(
            f"{_name(env)}.reset takes no seed: write reset(self, *, seed=None, options=None) and "
            "super().reset(seed=seed)"
        ) from error
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
        raise UserError(f"{_name(env)}.reset returned {_kind(result)}: return the tuple (observation, info)")
    _check_observation(env, "reset", result[0])
    return result


def check_step(env: gym.Env, action: np.ndarray, result: Any) -> None:
    """A ``UserError`` where what ``env.step(action)`` returned is not as Gymnasium asks, or the action is NaN."""
    if not np.isfinite(action).all():
        raise UserError(f"the policy's action is {action}: its weights or its log_std are not finite")
    if not (isinstance(result, tuple) and len(result) == 5):
        raise UserError(
            f"{_name(env)}.step returned {_kind(result)}: return the tuple (observation, reward, terminated, "
            "truncated, info)"
        )
    _check_observation(env, "step", result[0])
    reward = result[1]
    if np.ndim(reward) or isinstance(reward, str) or not np.isfinite(np.asarray(reward, dtype=float)):
        found = f"of shape {np.shape(reward)}: return one number" if np.ndim(reward) else f"{reward!r}: return a number"
        raise UserError(f"{_name(env)}.step returned a reward {found}, float(reward)")
    for name, flag in zip(("terminated", "truncated"), result[2:4], strict=True):
        if np.ndim(flag) or np.asarray(flag).dtype.kind not in "bi":
            raise UserError(f"{_name(env)}.step returned {name}={flag!r}: return True or False")


def misshapen(env: gym.Env, method: str, error: Exception) -> UserError:
    """What to say where an observation does not go into the row of its environment."""
    return UserError(
        f"{_name(env)}.{method} returned an observation that is not of its observation_space: {error}: make them agree"
    )


def _check_observation(env: gym.Env, method: str, obs: Any) -> None:
    space = env.observation_space
    if isinstance(space, spaces.Dict):
        parts = [(f"observation['{key}']", part, key) for key, part in space.spaces.items()]
        missing = [key for _, _, key in parts if not (isinstance(obs, dict) and key in obs)]
        if missing:
            raise UserError(f"{_name(env)}.{method} returned no observation['{missing[0]}'], which its space has")
    else:
        parts = [("observation", space, None)]
    for name, part, key in parts:
        if isinstance(part, spaces.Box) and (found := np.shape(obs if key is None else obs[key])) != part.shape:
            raise UserError(
                f"{_name(env)}.{method} returned {name} of shape {found}, its space says {part.shape}: make them agree"
            )


def _name(env: gym.Env) -> str:
    return type(env.unwrapped).__name__


def _kind(result: Any) -> str:
    return f"a tuple of {len(result)}" if isinstance(result, tuple) else f"a {type(result).__name__}"
