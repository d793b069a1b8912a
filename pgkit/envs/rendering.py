"""Pictures of MuJoCo and of any Gymnasium environment, without a display."""

from __future__ import annotations

import atexit
import ctypes
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from logging import getLogger
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch.nn.functional import interpolate

from pgkit.errors import UserError

PACKAGES = "apt-get install libegl1 libgl1-mesa-dri (EGL), or libosmesa6 (OSMesa)"
SHADOW_MAP = 512  # of 4,096 in dm_control's models: the shadow map is most of the time, and hardly in the picture


def choose_backend() -> str | None:
    """Sets ``MUJOCO_GL`` where it is not set: ``egl``, else ``osmesa``, whichever can be loaded; None: neither.

    MuJoCo and dm_control read it when they are imported first, so this comes before.
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        found = next((name for name, works in (("egl", _egl), ("osmesa", _osmesa)) if works()), None)
        if found is not None:
            os.environ["MUJOCO_GL"] = found
    return os.environ.get("MUJOCO_GL")


@cache
def _egl() -> bool:
    probe = Path(__file__).with_name("egl_probe.py")
    return subprocess.run([sys.executable, "-I", probe], capture_output=True, check=False).returncode == 0


@cache
def _osmesa() -> bool:
    for name in ("libOSMesa.so", "libOSMesa.so.8", "libOSMesa.so.6"):
        try:
            ctypes.CDLL(name)
            return True
        except OSError:
            continue
    return False


def renderer(env: gym.Env, size: int, fast: bool) -> Callable[[], np.ndarray]:
    """A function that draws an environment as it is, uint8 ``[size, size, 3]``, and keeps what it draws with.

    Args:
        env: with ``render_mode="rgb_array"``.
        size: of the picture.
        fast: without shadows, reflections and multisampling; MuJoCo alone.

    Raises:
        UserError: nothing can draw here; the message has the packages.
    """
    inner: Any = env.unwrapped
    control = sys.modules.get("shimmy.dm_control_compatibility")
    if control is not None and isinstance(inner, control.DmControlCompatibilityV0):
        return _drawn_by_mujoco(inner, size, fast)
    mujoco = sys.modules.get("mujoco")
    model = vars(inner).get("model")
    if mujoco is not None and isinstance(model, mujoco.MjModel):
        _lighten(model, size, fast)
    elif fast:
        raise UserError(f"fast_render=True is for MuJoCo, this is a {type(inner).__name__}: leave it out")

    def draw() -> np.ndarray:
        picture: Any = env.render()
        if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.shape[2] != 3:
            raise UserError(
                f"{type(inner).__name__}.render() gave {_kind(picture)}, pixels= needs uint8 (height, width, 3)"
            )
        return picture if picture.shape[:2] == (size, size) else resized(picture, size)

    return draw


def _kind(picture: Any) -> str:
    return f"shape {picture.shape}" if isinstance(picture, np.ndarray) else f"a {type(picture).__name__}"


def _drawn_by_mujoco(inner: Any, size: int, fast: bool) -> Callable[[], np.ndarray]:
    """Of dm_control: one renderer, made again where the environment has another model."""
    made: list[MuJoCo] = []

    def draw() -> np.ndarray:
        physics = inner._env.physics
        if not made or made[0].model is not physics.model.ptr:
            for before in made:
                before.free()
            _lighten(physics.model.ptr, size, fast)
            made[:] = [MuJoCo(physics.model.ptr, size, inner.render_kwargs.get("camera_id", 0))]
        return made[0](physics.data.ptr)

    return draw


class MuJoCo:
    """A renderer that is kept, ``data`` to uint8 ``[size, size, 3]``.

    ``mujoco.Renderer`` draws with what ``MUJOCO_GL`` was when MuJoCo was imported, and TorchRL imports it early.
    """

    def __init__(self, model: Any, size: int, camera: int) -> None:
        import mujoco

        backend = os.environ.get("MUJOCO_GL")
        self.model, self.mujoco = model, mujoco
        self.context = (import_module(f"mujoco.{backend}") if backend else mujoco).GLContext(size, size)
        self.context.make_current()
        self.scene, self.option = mujoco.MjvScene(model, maxgeom=1000), mujoco.MjvOption()
        self.camera, self.rect = mujoco.MjvCamera(), mujoco.MjrRect(0, 0, size, size)
        self.camera.fixedcamid, self.camera.type = camera, mujoco.mjtCamera.mjCAMERA_FIXED
        if not 0 <= camera < model.ncam:
            mujoco.mjv_defaultFreeCamera(model, self.camera)
        self.into = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.into)
        self.out = np.empty((size, size, 3), np.uint8)
        atexit.register(self.free)  # before MuJoCo ends EGL itself

    def free(self) -> None:
        """Gives back the memory that it draws in."""
        atexit.unregister(self.free)
        self.context.make_current()
        self.into.free()
        self.context.free()

    def __call__(self, data: Any) -> np.ndarray:
        mujoco, everything = self.mujoco, self.mujoco.mjtCatBit.mjCAT_ALL
        self.context.make_current()
        mujoco.mjv_updateScene(self.model, data, self.option, None, self.camera, everything, self.scene)
        mujoco.mjr_render(self.rect, self.scene, self.into)
        mujoco.mjr_readPixels(self.out, None, self.rect, self.into)
        return self.out[::-1]


def _lighten(model: Any, size: int, fast: bool) -> None:
    """What a model's pictures are made of; before the first one, and nothing that its physics reads."""
    model.vis.global_.offwidth = model.vis.global_.offheight = size
    model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, SHADOW_MAP)
    if fast:
        model.vis.quality.offsamples = 0
        model.light_castshadow[:] = 0
        model.mat_reflectance[:] = 0


def resized(picture: np.ndarray, size: int) -> np.ndarray:
    """``[height, width, 3]`` as ``[size, size, 3]``: each pixel the mean of those that it covers."""
    channels_last = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1).unsqueeze(0)
    small = interpolate(channels_last, (size, size), mode="bilinear", antialias=True)
    return small[0].permute(1, 2, 0).numpy()


def cannot_draw(env: gym.Env, error: Exception) -> UserError:
    """What to say where the first picture failed."""
    backend = os.environ.get("MUJOCO_GL")
    told = f"MUJOCO_GL={backend}" if backend else "neither EGL nor OSMesa is there"
    return UserError(
        f"{type(env.unwrapped).__name__} cannot be rendered here ({told}; {type(error).__name__}: "
        f"{(str(error) or 'no reason given').splitlines()[0]}): for MuJoCo {PACKAGES}, and leave MUJOCO_GL unset"
    )


@cache
def say_who_draws() -> None:
    """Logs once which library draws and on what: EGL may fall back to the CPU without a word."""
    if "OpenGL" in sys.modules:
        from OpenGL import GL

        name: Any = GL.glGetString(GL.GL_RENDERER)
        name = name.decode() if isinstance(name, bytes) else name
        getLogger("pgkit").info("rendering with MUJOCO_GL=%s on %s", os.environ.get("MUJOCO_GL", "(unset)"), name)
