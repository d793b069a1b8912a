"""Images as observations: rendered ones, and stacks of frames."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from pgkit.envs import rendering
from pgkit.errors import UserError


class Pixels(gym.Wrapper):
    """Pictures in place of observations, channels first: uint8 ``[3, size, size]``.

    Args:
        env: with ``render_mode="rgb_array"``.
        size: of the picture.
        fast: as ``fast_render`` of :func:`~pgkit.envs.make`.

    Raises:
        UserError: the environment does not render arrays.
    """

    def __init__(self, env: gym.Env, size: int, fast: bool = False) -> None:
        super().__init__(env)
        if env.render_mode != "rgb_array":
            raise UserError(
                f"pixels={size} draws the environment, this {type(env.unwrapped).__name__} has "
                f"render_mode={env.render_mode!r}: make it with render_mode='rgb_array'"
            )
        self.size, self.fast = size, fast
        self.observation_space = Box(0, 255, (3, size, size), np.uint8)
        self._draw: Any = None  # made at the first picture: a process that collects nothing needs no renderer

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        _, info = self.env.reset(seed=seed, options=options)
        return self.picture(), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        _, reward, terminated, truncated, info = self.env.step(action)
        return self.picture(), reward, terminated, truncated, info

    def picture(self) -> np.ndarray:
        """The environment as it is now, ``[3, size, size]``; a copy, as renderers give negative strides."""
        if self._draw is None:
            self._draw = rendering.renderer(self.env, self.size, self.fast)
            try:
                self._draw()
            except UserError:
                raise
            except Exception as error:  # each renderer has errors of its own
                raise rendering.cannot_draw(self.env, error) from error
            rendering.say_who_draws()
        return np.ascontiguousarray(self._draw().transpose(2, 0, 1))


class FrameStack(gym.Wrapper):
    """The last ``count`` observations along their first dimension, the newest last; at a start the first, repeated.

    ``[C, H, W]`` becomes ``[count * C, H, W]``, a gray image ``[H, W]`` ``[count, H, W]``.

    Raises:
        UserError: the observation is no Box, or an image with its channels last.
    """

    def __init__(self, env: gym.Env, count: int) -> None:
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, Box):
            raise UserError(f"frame_stack={count} stacks one array, the observation space is {space}")
        shape = space.shape
        if len(shape) == 3 and shape[2] < min(shape[:2]):
            raise UserError(
                f"frame_stack={count} stacks along the first dimension, the observation {shape} has its channels "
                "last: put them first in a wrapper (gymnasium.wrappers.TransformObservation, np.moveaxis(x, -1, 0))"
            )
        self.gray = len(shape) == 2
        low, high = (np.concatenate([self._frame(x)] * count) for x in (space.low, space.high))
        self.observation_space = Box(low, high, dtype=space.dtype.type)
        self.frames: deque[np.ndarray] = deque(maxlen=count)

    def _frame(self, obs: Any) -> np.ndarray:
        return obs[None] if self.gray else obs

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self.frames.extend([np.array(self._frame(obs))] * (self.frames.maxlen or 1))
        return np.concatenate(self.frames), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.frames.append(np.array(self._frame(obs)))  # a copy: an environment may write into its own
        return np.concatenate(self.frames), reward, terminated, truncated, info
