"""What an environment's resets and steps return, against Gymnasium's interface and its own spaces."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from pgkit.errors import UserError

# the usual types of flags and rewards, which need no look
FLAGS = {bool, np.bool_}
NUMBERS = {float, int, np.float64, np.float32, np.int64}
WRONG = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
)  # what reading an observation raises that is not of its space


def checked_space(env: gym.Env, name: str) -> gym.Space:
    """The environment's ``observation_space`` or ``action_space``; a ``UserError`` where it is none."""
    try:
        space: Any = env.get_wrapper_attr(name)
    except AttributeError:
        space = None
    if not isinstance(space, gym.Space):
        found = "missing" if space is None else f"a {type(space).__module__}.{type(space).__name__}"
        raise UserError(
            f"{_name(env)}.{name} is {found}, no gymnasium.spaces.Space: give one (an environment of the old gym: "
            "shimmy's gymnasium.make('GymV26Environment-v0', env_id=...))"
        )
    return space


def checked_reset(env: gym.Env, seed: int | None, options: dict[str, Any] | None) -> Any:
    """The observation of ``env.reset(seed=seed)``; a ``UserError`` where it does not return what Gymnasium asks for."""
    given: dict[str, Any] = {"seed": seed} if options is None else {"seed": seed, "options": dict(options)}
    try:
        result: Any = env.reset(**given)
    except TypeError as error:
        if not any(name in str(error) for name in given):
            raise
        raise UserError(
            f"{_name(env)}.reset takes no {' or no '.join(given)}: write reset(self, *, seed=None, options=None) "
            "and super().reset(seed=seed)"
        ) from error
    if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)):
        raise UserError(f"{_name(env)}.reset returned {_kind(result)}: return the tuple (observation, info)")
    return result[0]


def check_step(env: Any, action: np.ndarray, result: Any) -> None:
    """A ``UserError`` where what ``env.step(action)`` returned is not as Gymnasium asks, or the action is NaN."""
    if not np.isfinite(action).all():
        raise UserError(f"the policy's action is {action}: its weights or its log_std are not finite")
    if not (isinstance(result, tuple) and len(result) == 5):
        raise UserError(
            f"{_name(env)}.step returned {_kind(result)}: return the tuple (observation, reward, terminated, "
            "truncated, info)"
        )
    checked_reward(env, result[1])
    for name, flag in zip(("terminated", "truncated"), result[2:4], strict=True):
        checked_flag(env, name, flag)


def checked_reward(env: Any, reward: Any) -> float:
    """A reward as a number; a ``UserError`` for anything but one."""
    x = np.asarray(reward)
    if x.ndim:
        raise UserError(f"{_name(env)}.step returned a reward of shape {x.shape}: return one number, float(reward)")
    if x.dtype.kind not in "fiub" or not np.isfinite(x):
        raise UserError(f"{_name(env)}.step returned a reward {reward!r:.60}: return a number, float(reward)")
    return float(x)


def checked_flag(env: Any, name: str, flag: Any) -> bool:
    """A flag as a bool; a ``UserError`` for anything but True and False, or 1 and 0."""
    x = np.asarray(flag)
    if x.ndim or x.dtype.kind not in "biu" or x not in (0, 1):
        raise UserError(f"{_name(env)}.step returned {name}={flag!r:.60}: return True or False")
    return bool(x)


def misshapen(env: Any, method: str, error: Exception, agent: str = "") -> UserError:
    """What to say where an observation does not go into the row of its environment."""
    missing = f"the entry {error} is missing" if isinstance(error, KeyError) else str(error)
    return UserError(
        f"{_name(env)}.{method} returned an observation{agent} that is not of its observation_space: {missing:.200}: "
        "make them agree"
    )


def _name(env: Any) -> str:
    return type(env.unwrapped if isinstance(env, gym.Env) else env).__name__


def _kind(result: Any) -> str:
    return f"a tuple of {len(result)}" if isinstance(result, tuple) else f"a {type(result).__name__}"
