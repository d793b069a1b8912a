"""One id scheme for Gymnasium and dm_control."""

from __future__ import annotations

import dataclasses
import difflib
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
from torchrl.envs import EnvBase

from pgkit.envs.action_repeat import ActionRepeat
from pgkit.envs.vector import VectorEnv
from pgkit.errors import UserError, check_whole_number


def make(
    env_id: str | Callable[[], gym.Env],
    num_envs: int = 1,
    *,
    seed: int = 0,
    workers: int = 1,
    action_repeat: int = 1,
    flatten: bool = True,
    max_episode_steps: int | None = None,
    **kwargs: Any,
) -> VectorEnv:
    """Makes a vector of environments.

    Args:
        env_id: a Gymnasium id, ``dm_control/<domain>-<task>-v0`` (also ``dmc:<domain>-<task>``), or a function or
            class that makes one environment, a new one at every call.
        num_envs: number of environments.
        seed: seed of the whole vector; environment ``i`` gets its own stream.
        workers: processes that share the environments when a :class:`~pgkit.collectors.VectorCollector` collects.
        action_repeat: steps of the simulator for each action; a frame is then one decision, its reward their sum.
        flatten: a Dict observation becomes one vector, ``observation``; False keeps its entries apart, each under its
            own name: for one encoder per entry (:func:`pgkit.modules.dict_encoder`) and for action masks.
        max_episode_steps: time limit; None: the id's own, which a function or class has none of.
        **kwargs: passed to ``gymnasium.make``, to the dm_control task, or to the function or class.

    Raises:
        UserError: the id is unknown (the message has the nearest names), a package is missing (it has the
            install line), there are more workers than environments, there is no Dict to keep apart, or ``env_id`` is an
            environment.
    """
    if not (isinstance(env_id, str) or callable(env_id)) or isinstance(env_id, gym.Env | EnvBase):
        raise UserError(
            f"envs.make takes an id, or a function or class that makes one environment, this is a "
            f"{type(env_id).__name__}: envs.make(lambda: ...)"
        )
    if seed is None:
        raise UserError("seed=None: give a whole number; numpy.random.randint(2**31) is another in every run")
    check_whole_number(0, seed=seed, num_envs=num_envs, workers=workers)
    check_whole_number(1, action_repeat=action_repeat)
    if num_envs < 1 or workers < 1 or workers > num_envs:
        raise UserError(
            f"num_envs={num_envs}, workers={workers}: every worker needs at least one environment; "
            "choose 1 <= workers <= num_envs"
        )
    limited = isinstance(env_id, str) and not env_id.startswith(("dm_control/", "dmc:"))  # by Gymnasium
    if limited and max_episode_steps is not None:
        kwargs["max_episode_steps"] = max_episode_steps
    make_env = partial(make_one, env_id, **kwargs) if isinstance(env_id, str) else partial(env_id, **kwargs)
    if max_episode_steps is not None and not limited:
        make_env = partial(_limit, make_env, max_episode_steps)
    if action_repeat > 1:
        make_env = partial(_repeat, make_env, action_repeat)
    env = VectorEnv(make_env, num_envs, seed, workers, flatten)
    env.env_id = env_id if isinstance(env_id, str) else getattr(env_id, "__qualname__", type(env_id).__name__)
    if action_repeat > 1:
        env.env_id += f" (action repeat {action_repeat})"
    return env


def _limit(make_env: Callable[[], gym.Env], steps: int) -> gym.Env:
    return gym.wrappers.TimeLimit(make_env(), steps)


def _repeat(make_env: Callable[[], gym.Env], times: int) -> gym.Env:
    return ActionRepeat(make_env(), times)


def make_one(env_id: str, **kwargs: Any) -> gym.Env:
    """Makes one environment; ids and errors as in :func:`make`."""
    if env_id.startswith("dmc:"):
        env_id = f"dm_control/{env_id.removeprefix('dmc:')}-v0"
    try:
        if "mujoco" in _entry_point(env_id):
            _hear_mujoco()
        if env_id.startswith("dm_control/"):
            return _make_dm_control(env_id, **kwargs)
        spec = gym.registry.get(env_id)
        known = env_id if spec is None else dataclasses.replace(spec, order_enforce=False)  # always reset before a step
        return gym.make(known, disable_env_checker=True, **kwargs)
    except gym.error.UnregisteredEnv as error:
        if env_id.startswith("ALE/") and not any(known.startswith("ALE/") for known in gym.registry):
            raise UserError(
                f"environment '{env_id}' needs ale-py: pip install ale-py, then give its id as ale_py:{env_id}"
            ) from error
        raise _unknown(env_id, [known for known in gym.registry if not _successor(known)]) from error
    except (gym.error.DependencyNotInstalled, ImportError) as error:
        raise _not_installed(env_id, error) from error
    except gym.error.Error as error:
        raise UserError(f"environment '{env_id}': {str(error).splitlines()[0]}") from error
    except TypeError as error:
        if not kwargs or "argument" not in str(error):
            raise
        raise UserError(f"environment '{env_id}' cannot be made with these settings: {error}") from error


def _not_installed(env_id: str, error: Exception) -> UserError:
    module, colon, _ = env_id.partition(":")
    cause = error.__cause__ or error
    if colon and getattr(cause, "name", None) not in (None, module):
        return UserError(f"environment '{env_id}': importing '{module}' failed ({cause})")
    if colon:
        return UserError(f"environment '{env_id}': no module '{module}' to import, neither here nor installed")
    if newest := _successor(env_id):
        return UserError(f"environment '{env_id}' is one of Gymnasium's former ones: use {newest}")
    reason = str(error).splitlines()[0].rstrip(".")
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
    return UserError(f"unknown environment id '{env_id}'{hint}; where a package registers it: PACKAGE:{env_id}")


def _extra(env_id: str) -> str:
    if env_id.startswith("dm_control/"):
        return "shimmy[dm-control]"
    entry = _entry_point(env_id)
    for family in ("box2d", "mujoco", "toy_text", "classic_control"):
        if family in entry:
            return f"gymnasium[{family.replace('_', '-')}]"
    return "gymnasium[all]"
