"""Environments of every kind behind one function."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, cast

import gymnasium as gym
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv as GymVectorEnv
from torchrl.envs import EnvBase

from pgkit.compiled import Mode, check_compile
from pgkit.envs.action_repeat import ActionRepeat
from pgkit.envs.agents import Names
from pgkit.envs.gym_list import Gymnasium
from pgkit.envs.gym_vector import GymnasiumVector
from pgkit.envs.ids import changed, is_atari, make_one, rendered
from pgkit.envs.limits import limited
from pgkit.envs.numpy_entries import Info
from pgkit.envs.parallel import Parallel, is_parallel, refuse_turns
from pgkit.envs.pixels import FrameStack, Pixels
from pgkit.envs.seeding import episode_seed
from pgkit.envs.statistics import warn_of_statistics
from pgkit.envs.torch_batch import Torch
from pgkit.envs.vector import VectorEnv
from pgkit.envs.vmas_batch import Vmas
from pgkit.errors import UserError, check_whole_number
from pgkit.seams import Simulator


class Settings(NamedTuple):
    """What :func:`make` was asked for besides the environment."""

    device: torch.device | str | None = None
    action_repeat: int = 1
    flatten: bool = True
    info: Info = ()
    time_limit: int | None = None
    pixels: int | None = None
    frame_stack: int = 1
    fast_render: bool = False
    reward_clipping: bool = False
    groups: Names | None = None
    compile: str = "off"
    env_timeout: float | None = None
    reseed: bool = True
    reset_options: Mapping[str, Any] | None = None


def make(
    env_id: str | EnvSpec | EnvBase | GymVectorEnv | Callable[..., Any],
    num_envs: int | None = None,
    *,
    seed: int = 0,
    device: torch.device | str | None = None,
    workers: int = 1,
    action_repeat: int = 1,
    flatten: bool = True,
    info: Info = (),
    max_episode_steps: int | None = None,
    pixels: int | None = None,
    frame_stack: int | None = None,
    fast_render: bool = False,
    reward_clipping: bool | None = None,
    groups: Names | None = None,
    compile: str = "off",
    env_timeout: float | None = None,
    restart_workers: bool = False,
    reseed: bool = True,
    reset_options: Mapping[str, Any] | None = None,
    **kwargs: Any,
) -> VectorEnv:
    """Makes a vector of environments.

    Args:
        env_id: a Gymnasium id or ``EnvSpec``, ``dm_control/<domain>-<task>-v0`` (also ``dmc:<domain>-<task>``),
            ``vmas/<scenario>``, ``mpe2/<name>``; a vector of Gymnasium's (``gymnasium.make_vec(...)``); a TorchRL
            ``EnvBase`` with one batch dimension or none; or a function or class. What that returns decides what it is:
            one ``gym.Env``, ``dm_env`` or PettingZoo ``ParallelEnv``, a new one at every call, or one of the former. It
            gets ``num_envs``, ``seed`` and ``device`` if it names them.
        num_envs: number of environments; 1 by default, and what an object that is given has.
        seed: seed of the whole vector; environment ``i`` gets its own stream.
        device: where a TorchRL environment is to be; NumPy environments are on the CPU.
        workers: processes that share the environments when a :class:`~pgkit.collectors.VectorCollector` collects.
        action_repeat: steps of the simulator for each action; a frame is then one decision, its reward their sum.
        flatten: a Dict observation becomes one vector, ``observation``; False keeps its entries apart, each under its
            own name and in its own type: for one encoder per entry (:func:`pgkit.modules.dict_encoder`) and for
            action masks.
        info: entries of ``info`` that reach the rollout under ``("next", name)``: names of single numbers, or a
            mapping from names to TorchRL specs of one environment's; ``episode`` is what
            ``RecordEpisodeStatistics`` writes. A run logs their means at the ends of episodes.
        max_episode_steps: time limit; None: the id's own (VMAS's: 100), which a function or class has none of.
        groups: of many agents, their names by the name of their group; None: one group, or by the beginnings of their
            names where their spaces differ.
        reseed: every episode has a seed of its own, so that a resume can replay it. False seeds each environment once,
            for one that counts on a single stream of random numbers (a curriculum); a resume then begins new episodes.
        reset_options: given to every reset as Gymnasium's ``options``.
        compile: ``auto`` records the step of a batched torch simulator (VMAS's, or a function that makes a TorchRL
            ``EnvBase``) and compiles it: about ten times as fast, after up to a minute the first time. What cannot be
            recorded runs as it is, with a line in the log; other environments have nothing to record. ``on``: then it
            is a ``UserError``.
        env_timeout: seconds that one step of a process's environments may take; None: any time.
        restart_workers: a worker process that has ended or hangs is replaced. Its environments go on where they were,
            those that cannot (:attr:`~pgkit.seams.Simulator.resume`) begin new episodes.
        **kwargs: passed to ``gymnasium.make``, to the dm_control task, or to the function or class.

    Raises:
        UserError: the id is unknown (the message has the nearest names), a package is missing (it has the
            install line), there are more workers than environments, there is no Dict to keep apart, or a setting is
            not one for this kind of environment.
    """
    if seed is None:
        raise UserError("seed=None: give a whole number; numpy.random.randint(2**31) is another in every run")
    check_compile(compile)
    check_whole_number(0, seed=seed, num_envs=num_envs, workers=workers)
    check_whole_number(1, action_repeat=action_repeat, pixels=pixels, frame_stack=frame_stack)
    atari = is_atari(env_id)
    stack = (4 if atari else 1) if frame_stack is None else frame_stack
    clips = atari if reward_clipping is None else reward_clipping
    if isinstance(env_id, EnvBase | GymVectorEnv):
        _refuse_more(workers, kwargs)
        images = (pixels, stack, fast_render, clips)
        rest = (max_episode_steps, *images, groups, compile, env_timeout, reseed, reset_options)
        given = Settings(device, action_repeat, flatten, info, *rest)
        return _adopt(env_id, num_envs, seed, given)
    num_envs = 1 if num_envs is None else num_envs
    if num_envs < 1 or workers < 1 or workers > num_envs:
        raise UserError(
            f"num_envs={num_envs}, workers={workers}: every worker needs at least one environment; "
            "choose 1 <= workers <= num_envs"
        )
    if isinstance(env_id, EnvSpec):
        env_id, kwargs = env_id.id, {**changed(env_id), **kwargs}
    limited = isinstance(env_id, str) and not env_id.startswith(("dm_control/", "dmc:"))  # by Gymnasium
    if limited and max_episode_steps is not None:
        kwargs["max_episode_steps"] = max_episode_steps
    if atari:
        kwargs |= {} if pixels is None else {"screen_size": pixels}
    elif isinstance(env_id, str) and pixels is not None:
        kwargs = rendered(env_id, pixels) | kwargs
    images = (None if atari else pixels, stack, fast_render, clips)
    rest = (None if limited else max_episode_steps, *images, groups, compile, env_timeout, reseed, reset_options)
    settings = Settings(device, action_repeat, flatten, info, *rest)
    function = _function(env_id, kwargs)
    env = VectorEnv(partial(_limited, function, settings), num_envs, seed, workers)
    env.env_timeout, env.restart_workers = env_timeout, restart_workers
    name = env_id if isinstance(env_id, str) else getattr(env_id, "__qualname__", type(env_id).__name__)
    env.env_id = name if action_repeat == 1 else f"{name} (action repeat {action_repeat})"
    if stack > 1:
        env.frame_stack = stack
    return env


def vector_of(env: Any) -> VectorEnv:
    """What :func:`make` makes of a TorchRL environment or of a simulator; what it made stays as it is.

    The seed of any other environment is drawn from torch's global generator.
    """
    if isinstance(env, Simulator):
        return VectorEnv(lambda first, count, seed: env, splits=False)
    if not isinstance(env, EnvBase):
        raise UserError(
            f"pgkit plays what envs.make gives, a {type(env).__name__} is none of that: envs.make(id or function)"
        )
    return env if isinstance(env, VectorEnv) else make(env, seed=int(torch.randint(2**31, ())))


def _refuse_more(workers: int, kwargs: dict[str, Any]) -> None:
    """A UserError for settings that an environment which is made already cannot follow."""
    if workers > 1 or kwargs:
        what = f"workers={workers}" if workers > 1 else f"{next(iter(kwargs))}=..."
        raise UserError(f"{what} with an environment that is made already: give a function that makes one")


def _adopt(env: EnvBase | GymVectorEnv, num_envs: int | None, seed: int, settings: Settings) -> VectorEnv:
    """An environment that is there already."""
    if isinstance(env, VectorEnv):
        raise UserError("envs.make was given what envs.make gives: use it as it is")
    adopted = VectorEnv(
        lambda first, count, seed: limited(_simulator(env, seed, first, settings), settings.env_timeout),
        1, seed, splits=False,
    )  # fmt: skip
    if num_envs not in (None, adopted.num_envs):
        raise UserError(f"num_envs={num_envs}: the {type(env).__name__} given is {adopted.num_envs}: leave it out")
    adopted.env_id = type(env).__name__
    return adopted


def _function(env_id: Any, kwargs: dict[str, Any]) -> Callable[..., Any]:
    if isinstance(env_id, str) and env_id.startswith("vmas/"):
        return partial(Vmas, env_id.removeprefix("vmas/"), **kwargs)
    if isinstance(env_id, str):
        return partial(make_one, env_id, **kwargs)
    if not callable(env_id) or isinstance(env_id, gym.Env):
        raise UserError(
            "envs.make takes an id, a function or class that makes an environment, an EnvSpec, a gymnasium.vector."
            f"VectorEnv or a TorchRL EnvBase, this is a {type(env_id).__name__}: envs.make(lambda: ...)"
        )
    return partial(env_id, **kwargs)


def _limited(function: Callable[..., Any], settings: Settings, first: int, count: int, seed: int) -> Simulator:
    """As :func:`_share`, with the limit on the time of a step."""
    return limited(_share(function, settings, first, count, seed), settings.env_timeout)


def _share(function: Callable[..., Any], settings: Settings, first: int, count: int, seed: int) -> Simulator:
    """The environments ``first`` to ``first + count``: what the function makes decides how."""
    own_seed = seed % 2**31 if first == 0 else episode_seed(seed, first, 0)
    given = {"num_envs": count, "seed": own_seed, "device": settings.device, "groups": settings.groups}
    given |= {"compile": None if settings.compile == "off" else settings.compile}
    names = _named(function) - {name for name, value in given.items() if value is None}
    made = function(**{name: given[name] for name in names & given.keys()})
    if isinstance(made, EnvBase | GymVectorEnv):
        simulator = _simulator(made, own_seed, first, settings)
        if simulator.num_envs != count:
            raise UserError(
                f"the function made {simulator.num_envs} environments where num_envs={count}: let it take num_envs"
            )
        return simulator
    apart = {"info=": bool(settings.info), "flatten=False": not settings.flatten}
    if isinstance(made, Simulator):
        resets = {"reseed=False": not settings.reseed, "reset_options=": settings.reset_options is not None}
        _only_for_single(settings, made, apart | resets)
        return made
    refuse_turns(made)
    if settings.compile == "on":
        raise UserError(
            f"compile='on' records batched torch simulators, a {type(made).__name__} is none: 'auto' or 'off'"
        )
    rest = []
    for i in range(first + 1, first + count):
        given["seed"] = episode_seed(seed, i, 0)
        rest.append(function(**{name: given[name] for name in names & given.keys()}))
    if is_parallel(made):
        _only_for_single(settings, made, apart)
        return Parallel([made, *rest], seed, first, settings.groups, settings.reseed, settings.reset_options)
    if settings.groups is not None:
        raise UserError(f"groups= is for environments with many agents, {type(made).__name__} has one: leave it out")
    warn_of_statistics(made)
    envs, resets = [_one(env, settings) for env in (made, *rest)], (settings.reseed, settings.reset_options)
    return Gymnasium(envs, seed, first, settings.flatten, settings.info, settings.reward_clipping, *resets)


def _named(function: Any) -> set[str]:
    """The arguments that a function or class names and that are not given yet."""
    taken: set[str] = set()
    while isinstance(function, partial):
        taken |= function.keywords.keys()
        function = function.func
    try:
        return set(inspect.signature(function.__init__ if isinstance(function, type) else function).parameters) - taken
    except (TypeError, ValueError):  # built in
        return set()


def _only_for_single(settings: Settings, env: Any, also: Mapping[str, bool], instead: str = "leave it out") -> None:
    """A ``UserError`` for a setting that single Gymnasium environments have, and this one does not.

    Args:
        also: further settings, and whether they are given.
        instead: what to do.
    """
    given = {
        "action_repeat=": settings.action_repeat > 1, "max_episode_steps=": settings.time_limit is not None,
        "pixels=": settings.pixels is not None, "frame_stack=": settings.frame_stack > 1,
        "reward_clipping=": settings.reward_clipping, **also,
    }  # fmt: skip
    if named := [name for name, is_given in given.items() if is_given]:
        raise UserError(f"{named[0]} is for single Gymnasium environments, this is a {type(env).__name__}: {instead}")


def _simulator(env: EnvBase | GymVectorEnv, seed: int, first: int, settings: Settings) -> Simulator:
    wrappers = "use one of its library's wrappers (TorchRL: StepCounter(max_steps=...), FrameSkipTransform(...))"
    options = settings.reset_options is not None and isinstance(env, EnvBase)
    _only_for_single(settings, env, {"reset_options=": options}, wrappers)
    if not settings.reseed:
        raise UserError(f"reseed=False: {type(env).__name__} is seeded once anyway: leave it out")
    warn_of_statistics(env)
    if isinstance(env, GymVectorEnv):
        if settings.compile == "on":
            raise UserError(f"compile='on' records torch simulators, a {type(env).__name__} is none: 'auto' or 'off'")
        return GymnasiumVector(env, seed, first, settings.flatten, settings.info, settings.reset_options)
    env = env if settings.device is None else env.to(settings.device)
    return Torch(env, seed, first, settings.info, cast(Mode, settings.compile))


def _one(env: Any, settings: Settings) -> gym.Env:
    """One Gymnasium environment with its wrappers."""
    dm_env = sys.modules.get("dm_env")
    if dm_env is not None and isinstance(env, dm_env.Environment):
        from shimmy.dm_control_compatibility import DmControlCompatibilityV0

        env = DmControlCompatibilityV0(env, render_mode=None if settings.pixels is None else "rgb_array")
    if not isinstance(env, gym.Env):
        raise UserError(
            f"the function that makes an environment made a {type(env).__name__}: it must make a gym.Env, a "
            "gymnasium.vector.VectorEnv, a TorchRL EnvBase or a dm_control environment"
        )
    if settings.time_limit is not None:
        env = gym.wrappers.TimeLimit(env, settings.time_limit)
    env = ActionRepeat(env, settings.action_repeat) if settings.action_repeat > 1 else env
    if settings.pixels is not None:
        env = Pixels(env, settings.pixels, settings.fast_render)
    elif settings.fast_render:
        raise UserError("fast_render=True is how pixels= are drawn: give pixels=84, or leave it out")
    return FrameStack(env, settings.frame_stack) if settings.frame_stack > 1 else env
