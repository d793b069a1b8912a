"""Atari games as Machado et al. (2018, https://arxiv.org/abs/1709.06009) play them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from pgkit.errors import UserError


def make_atari(
    env_id: str,
    *,
    frameskip: int = 4,
    noop: int = 30,
    screen_size: int = 84,
    grayscale: bool = True,
    episodic_life: bool = False,
    **kwargs: Any,
) -> gym.Env:
    """One game, single frames: uint8 ``[screen_size, screen_size]``, in color ``[3, screen_size, screen_size]``.

    Sticky actions are the id's: with probability 0.25 a game of version 5 repeats the action before.

    Args:
        env_id: ``ALE/Pong-v5`` and others.
        frameskip: frames of the game for each action; the picture is the larger of the last two, pixel by pixel.
        noop: an episode begins with up to so many actions that do nothing.
        screen_size: side of the picture.
        grayscale: gray pictures, or color.
        episodic_life: not offered.
        **kwargs: the game's: ``repeat_action_probability``, ``mode``, ``difficulty``, ``full_action_space``.

    Raises:
        UserError: ``episodic_life=True``, or a package or the game's ROM is missing.
    """
    if episodic_life:
        raise UserError(
            "episodic_life=True: an episode is a whole game here, so that every score is a game's "
            "(Machado et al., 2018); leave it out"
        )
    try:
        import ale_py
        import cv2  # noqa: F401
    except ImportError as error:
        raise UserError(
            f"environment '{env_id}' needs the package '{error.name}': pip install ale-py opencv-python-headless "
            "(pgkit's extra 'atari')"
        ) from error
    gym.register_envs(ale_py)
    try:
        game = gym.make(env_id, frameskip=1, disable_env_checker=True, **kwargs)
    except OSError as error:
        raise UserError(
            f"environment '{env_id}': its ROM cannot be read ({error}): install ale-py anew, which brings the ROMs, "
            "and leave ALE_ROMS_DIR unset"
        ) from error
    settings = {"noop_max": noop, "frame_skip": frameskip, "screen_size": screen_size, "grayscale_obs": grayscale}
    env = gym.wrappers.AtariPreprocessing(game, **settings)
    return env if grayscale else ChannelsFirst(env)


class ChannelsFirst(gym.ObservationWrapper):
    """Images ``[H, W, C]`` as ``[C, H, W]``."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        space: Any = env.observation_space
        self.observation_space = gym.spaces.Box(
            space.low.transpose(2, 0, 1), space.high.transpose(2, 0, 1), dtype=space.dtype.type
        )

    def observation(self, observation: Any) -> Any:
        return observation.transpose(2, 0, 1)
