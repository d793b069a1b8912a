"""Gymnasium's and dm_control's environments by one scheme of ids."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import pkgutil
import re
import warnings
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from pgkit.envs.atari import make_atari
from pgkit.envs.rendering import PACKAGES, choose_backend
from pgkit.errors import UserError

_PLUGINS = {  # ids that a package registers when it is imported
    "MiniGrid-": "minigrid", "BabyAI-": "minigrid", "MiniWorld-": "miniworld", "highway-": "highway_env",
    "Fetch": "gymnasium_robotics", "AntMaze": "gymnasium_robotics", "PointMaze": "gymnasium_robotics",
    "Adroit": "gymnasium_robotics", "FrankaKitchen": "gymnasium_robotics", "Meta-World/": "metaworld",
}  # fmt: skip


def make_one(env_id: str, **kwargs: Any) -> Any:
    """Makes one environment, a ``gym.Env`` or PettingZoo's; ids and errors as in :func:`make`."""
    if env_id.startswith("dmc:"):
        env_id = f"dm_control/{env_id.removeprefix('dmc:')}-v0"
    module, colon, name = env_id.partition(":")
    try:
        if env_id.startswith("mpe2/"):
            return _make_mpe2(env_id, **kwargs)
        if colon and name.isidentifier() and name in (found := vars(importlib.import_module(module))):
            return found[name](**kwargs)
        if "mujoco" in _entry_point(env_id):
            choose_backend()
            _hear_mujoco()
        if env_id.startswith("dm_control/"):
            return _make_dm_control(env_id, **kwargs)
        if is_atari(env_id):
            return make_atari(env_id.removeprefix("ale_py:"), **kwargs)
        spec = gym.registry.get(env_id)
        known = env_id if spec is None else dataclasses.replace(spec, order_enforce=False)  # always reset before a step
        return gym.make(known, disable_env_checker=True, **kwargs)
    except gym.error.UnregisteredEnv as error:
        raise _unknown(env_id, [known for known in gym.registry if not _successor(known)]) from error
    except (gym.error.DependencyNotInstalled, ImportError) as error:
        raise _not_installed(env_id, error) from error
    except gym.error.Error as error:
        raise UserError(f"environment '{env_id}': {str(error).splitlines()[0]}") from error
    except TypeError as error:
        if not re.search(r"missing \d+ required|unexpected keyword argument", str(error)):
            raise
        reason = str(error).partition(" was raised from")[0]
        raise UserError(
            f"environment '{env_id}' cannot be made with these settings: {reason}; --env.KEYWORD VALUE (envs.make(..., "
            "keyword=value)) gives one"
        ) from error


def changed(spec: EnvSpec) -> dict[str, Any]:
    """The keywords with which ``gymnasium.make(spec.id, ...)`` gives what ``spec`` says."""
    known = gym.registry.get(spec.id)
    if known is None or spec.additional_wrappers or spec.entry_point != known.entry_point:
        raise UserError(
            f"the EnvSpec of '{spec.id}' is not the registered one: give envs.make a function, lambda: spec.make()"
        )
    limit = {} if spec.max_episode_steps == known.max_episode_steps else {"max_episode_steps": spec.max_episode_steps}
    return {**limit, **spec.kwargs}


def _make_mpe2(env_id: str, max_episode_steps: int | None = None, **kwargs: Any) -> Any:
    """One of mpe2's, which registers no ids: each is a module with a function ``parallel_env``."""
    import mpe2

    name, known = env_id.removeprefix("mpe2/"), [x.name for x in pkgutil.iter_modules(mpe2.__path__)]
    known = [x for x in known if x.rpartition("_v")[2].isdigit()]
    if name not in known:
        raise _unknown(env_id, [f"mpe2/{x}" for x in known])
    limit = {} if max_episode_steps is None else {"max_cycles": max_episode_steps}
    return importlib.import_module(f"mpe2.{name}").parallel_env(**limit, **kwargs)


def is_atari(env_id: Any) -> bool:
    """Whether an id is that of an Atari game, ``ALE/Pong-v5``."""
    return isinstance(env_id, str) and env_id.startswith(("ALE/", "ale_py:ALE/"))


def rendered(env_id: str, size: int) -> dict[str, Any]:
    """Keywords with which an environment renders arrays, MuJoCo's of this size."""
    sized = not env_id.startswith(("dm_control/", "dmc:")) and "mujoco" in _entry_point(env_id)
    return {"render_mode": "rgb_array", **({"width": size, "height": size} if sized else {})}


def _not_installed(env_id: str, error: Exception) -> UserError:
    module, colon, _ = env_id.partition(":")
    cause = error.__cause__ or error
    if colon and getattr(cause, "name", None) not in (None, module):
        return UserError(f"environment '{env_id}': importing '{module}' failed ({cause})")
    if colon:
        return UserError(
            f"environment '{env_id}': no module '{module}' to import, neither here nor installed (pip install {module})"
        )
    if newest := _successor(env_id):
        return UserError(f"environment '{env_id}' is one of Gymnasium's former ones: use {newest}")
    reason = str(error).splitlines()[0].rstrip(".")
    if any(name in reason for name in ("EGL", "OSMesa", "OpenGL")):
        return UserError(f"environment '{env_id}' cannot be rendered here ({reason}): {PACKAGES}")
    return UserError(
        f"environment '{env_id}' needs a package that is not installed ({reason}): pip install \"{_extra(env_id)}\""
    )


def _successor(env_id: str) -> str | None:
    """The newest version of an environment, if MuJoCo's version 2 or 3 is asked for; those live in another package."""
    name, _, version = env_id.rpartition("-v")
    if version not in ("2", "3"):
        return None
    newest = max((spec.version or 0 for spec in gym.registry.values() if spec.name == name), default=0)
    return f"{name}-v{newest}" if newest > 3 else None


def _entry_point(env_id: str) -> str:
    if env_id.startswith("dm_control/"):
        return "dm_control.mujoco"
    spec = gym.registry.get(env_id)
    return str(spec.entry_point) if spec else ""


def _hear_mujoco() -> None:
    """MuJoCo's warnings become Python's, deprecations in Gymnasium's model files left out; no MUJOCO_LOG.TXT."""
    import mujoco

    def hear(message: bytes | str) -> None:
        text = message.decode() if isinstance(message, bytes) else message
        if "deprecated" not in text:
            warnings.warn(f"MuJoCo: {text}", RuntimeWarning, stacklevel=2)

    mujoco.set_mju_user_warning(hear)


def _make_dm_control(env_id: str, **kwargs: Any) -> gym.Env:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # glfw says at import that there is no display
        from dm_control import suite
        from shimmy.dm_control_compatibility import DmControlCompatibilityV0
    _hear_mujoco()  # again: dm_control has put its own hearer in place
    domain, _, task = env_id.removeprefix("dm_control/").removesuffix("-v0").partition("-")
    tasks = [(d, t) for d, t in suite.ALL_TASKS]
    if (domain, task) not in tasks:
        raise _unknown(env_id, [f"dm_control/{d}-{t}-v0" for d, t in tasks])
    rendering = {key: kwargs.pop(key) for key in ("render_mode", "render_kwargs") if key in kwargs}
    return DmControlCompatibilityV0(suite.load(domain, task, task_kwargs=kwargs or None), **rendering)


def _unknown(env_id: str, known: list[str]) -> UserError:
    nearest = difflib.get_close_matches(env_id, known, n=3, cutoff=0.4)
    hint = f"; the nearest names are {', '.join(nearest)}" if nearest else "; see gymnasium.pprint_registry()"
    package, _, name = env_id.rpartition(":")
    package = package or next((x for start, x in _PLUGINS.items() if env_id.startswith(start)), "PACKAGE")
    registers = f"{package}:{name:.100}"
    return UserError(f"unknown environment id '{env_id:.100}'{hint}; where a package registers it: {registers}")


def _extra(env_id: str) -> str:
    if env_id.startswith("mpe2/"):
        return "pgkit-rl[agents]"
    if env_id.startswith("dm_control/"):
        return "shimmy[dm-control]"
    entry = _entry_point(env_id)
    for family in ("box2d", "mujoco", "toy_text", "classic_control"):
        if family in entry:
            return f"gymnasium[{family.replace('_', '-')}]"
    return "gymnasium[all]"
