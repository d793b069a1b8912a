"""Episodes as a video: MP4 where there is a codec, else GIF."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from logging import getLogger
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from pgkit import files
from pgkit.envs.gym_list import Gymnasium
from pgkit.envs.parallel import Parallel
from pgkit.envs.vmas_batch import Vmas
from pgkit.errors import UserError
from pgkit.run.evaluate import evaluate
from pgkit.run.exported import needs
from pgkit.run.policy import Policy

FPS = 30  # where an environment does not say


def record(policy: Policy, file: Path, episodes: int, seed: int = 0) -> tuple[dict[str, float], Path]:
    """Plays whole episodes one after the other and records them; the scores of :func:`evaluate`, and the file.

    Args:
        policy: from ``load_policy``.
        file: ``.mp4`` or ``.gif``; without a codec for MP4 it becomes a GIF of the same name.
        episodes: how many.
        seed: of the environment.

    Raises:
        UserError: imageio is missing (extra ``video``), the ending is another, or the environment cannot be rendered.
    """
    imageio, file = needs("imageio.v2", "video"), _with_codec(file)
    if policy.args is None:
        raise UserError("a video is made of a run's policy: run.load_policy(RUN_DIR)")
    drawn = {} if policy.args.env_id.startswith("vmas/") else {"render_mode": "rgb_array"}
    shown = dataclasses.replace(policy.args, env={**policy.args.env, **drawn}, env_timeout=None)
    env = shown.make_env(num_envs=1, seed=seed)
    simulator: Any = env.simulator
    try:
        if not isinstance(simulator, Gymnasium | Parallel | Vmas):
            raise UserError(
                f"--video: {env.env_id} cannot be rendered: it is no Gymnasium or PettingZoo environment and none of "
                "VMAS's"
            )
        fps = FPS if isinstance(simulator, Vmas) else int(simulator.envs[0].metadata.get("render_fps") or FPS)
        how = {"fps": fps, "macro_block_size": 2} if file.suffix == ".mp4" else {"duration": 1000 / fps, "loop": 0}
        writer = None

        def show(frame: np.ndarray) -> None:
            nonlocal writer
            writer = writer or imageio.get_writer(file, **how)
            writer.append_data(frame)

        try:
            _show(simulator, show)
            return evaluate(policy, env, episodes), file
        finally:
            if writer is not None:
                writer.close()
    finally:
        env.close()


def _show(simulator: Any, show: Callable[[np.ndarray], None]) -> None:
    """From now on every frame of the simulator is handed on."""
    if isinstance(simulator, Gymnasium):
        simulator.envs = [Shown(simulator.envs[0], show)]
    elif isinstance(simulator, Parallel):
        simulator.envs = [ShownParallel(simulator.envs[0], show)]
    else:
        advance = simulator.advance

        def shown(*actions: Any) -> Any:
            made = advance(*actions)
            show(frame(lambda: simulator.env.render("rgb_array")))
            return made

        vars(simulator)["advance"] = shown


def _with_codec(file: Path) -> Path:
    if file.suffix not in (".mp4", ".gif"):
        raise UserError(f"--video {file}: give a name that ends in .mp4 or .gif")
    if not file.parent.is_dir():
        raise UserError(f"--video {file}: no directory {file.parent}")
    if file.suffix == ".mp4":
        try:
            needs("imageio_ffmpeg", "video")
        except UserError as error:
            getLogger("pgkit").warning("MP4: %s; a GIF is written", error)
            file = file.with_suffix(".gif")
    with files.replacing(file.with_name(f"{file.name}.try")) as trial:
        trial.write(b"")  # before the episodes are played
    file.with_name(f"{file.name}.try").unlink()
    return file


class Shown(gym.Wrapper):
    """Hands on a frame of each reset and step."""

    def __init__(self, env: gym.Env, show: Callable[[np.ndarray], None]) -> None:
        super().__init__(env)
        self.show = show

    def reset(self, **kwargs: Any) -> Any:
        result = self.env.reset(**kwargs)
        self.show(frame(self.env.render))
        return result

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self.show(frame(self.env.render))
        return result


class ShownParallel:
    """The same of a PettingZoo parallel environment."""

    def __init__(self, env: Any, show: Callable[[np.ndarray], None]) -> None:
        self.env, self.show = env, show

    @property
    def agents(self) -> list[str]:
        return self.env.agents

    def reset(self, **kwargs: Any) -> Any:
        result = self.env.reset(**kwargs)
        self.show(frame(self.env.render))
        return result

    def step(self, actions: Any) -> Any:
        result = self.env.step(actions)
        if self.env.agents:  # some draw nothing at the end
            self.show(frame(self.env.render))
        return result

    def close(self) -> None:
        self.env.close()


def frame(render: Callable[[], Any]) -> np.ndarray:
    """An image of ``render``'s, ``[height, width, 3]``."""
    try:
        image = render()
    except Exception as error:  # each renderer has errors of its own
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise UserError(
            f"the environment cannot be rendered ({reason}): on a machine without a display set MUJOCO_GL=egl "
            "(Debian: libegl1) or MUJOCO_GL=osmesa (libosmesa6); VMAS needs a display: xvfb-run pgkit eval ..."
        ) from error
    if not isinstance(image, np.ndarray) or image.ndim != 3:
        raise UserError(f"render() gives a {type(image).__name__}, not an image [height, width, 3]")
    return image
