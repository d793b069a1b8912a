"""The settings that every recipe has, and what a setting says of itself beside its default."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import gymnasium as gym
import torch
import tyro

from pgkit import envs
from pgkit.cli.beside import look_in
from pgkit.errors import UserError


def setting(
    default: Any,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    on_resume: bool | None = None,
    follows: str | None = None,
) -> Any:
    """A field of a recipe's ``Args``, with its bounds. A subclass that overrides only the default keeps them.

    Args:
        low, high: least and largest value, of each number if there are several.
        above: a lower bound that the value must exceed.
        on_resume: a resumed run may change it, since it does not change what is learned.
        follows: the setting at which its schedule ends.
    """
    told = {"low": low, "high": high, "above": above, "on_resume": on_resume, "follows": follows}
    return field(default=default, metadata={key: value for key, value in told.items() if value is not None})


@dataclass
class RunArgs:
    """Settings of a run; a recipe's ``Args`` derives from it and adds the algorithm's own."""

    env_id: str = "CartPole-v1"
    """Gymnasium id, or dm_control/<domain>-<task>-v0; module:Id imports that module first."""
    env: Annotated[dict[str, Any], tyro.conf.Suppress] = field(default_factory=dict)
    """Keywords of the environment: --env.KEYWORD VALUE."""
    wrapper: str | None = None
    """Wrap every environment: module:function, imported from the working directory or installed."""
    action_repeat: int = setting(1, low=1, high=10_000)
    """Simulator steps for each action."""
    seed: int = setting(1, low=0, high=2**62)
    """Seeds the networks, the envs and the order of minibatches."""
    total_frames: int = setting(100_000, low=1, high=10**15, on_resume=True)
    """Env steps to train for, all envs together."""
    num_envs: int = setting(8, low=1, high=10**6)
    """Envs stepped side by side."""
    workers: int = setting(1, low=1, high=1024, on_resume=True)
    """Processes that the envs are spread over; the numbers stay the same."""
    env_timeout: float | None = setting(None, above=0, high=10**6, on_resume=True)
    """Seconds that a step of the environments may take; longer, and the run ends, or the worker is replaced."""
    restart_workers: bool = setting(False, on_resume=True)
    """Replace worker processes that end; their environments go on where they were, or begin new episodes."""
    device: Literal["auto", "cpu", "cuda"] = setting("auto", on_resume=True)
    """Where the networks are trained; auto: on the GPU where there is one."""
    run_dir: Path | None = None
    """Where to write the run (default: runs/{env}__{recipe}__{seed}__{time})."""
    eval_every: int = setting(50_000, low=0, high=10**15, on_resume=True)
    """Evaluate and save a checkpoint every so many frames; 0 = only at the end."""
    eval_episodes: int = setting(10, low=1, high=10**6, on_resume=True)
    """Whole episodes, with deterministic actions, in each evaluation."""
    compile: Literal["auto", "on", "off"] = setting("auto", on_resume=True)
    """Compile the update into one graph; auto: when the run is long enough to win the compile time back."""
    matmul: Literal["auto", "float32", "bf16"] = setting("auto", on_resume=True)
    """Kernels of large products in compiled updates on a CPU; auto: the fastest in float32 here, measured once;
    float32: PyTorch's own; bf16: also in bfloat16, less exact, where that is faster."""
    init: Path | None = setting(None, on_resume=True)
    """Begin with the trained agent of this run directory: fine-tuning."""
    resume: Path | None = setting(None, on_resume=True)
    """Run directory to go on with, by its own settings: only the length, evaluation, logging, workers, threads, device
    and compilation may be given anew. Also one of its checkpoints, RUN_DIR/checkpoints/best.pt."""
    resume_if_possible: bool = setting(False, on_resume=True)
    """Go on with --run-dir where it has a checkpoint, else begin there: one command for a run that is stopped."""
    trust: bool = setting(False, on_resume=True)
    """Import the modules that a run directory names: its environment's and its wrapper's."""
    threads: int = setting(1, low=0, high=256, on_resume=True)
    """Threads that PyTorch uses in this process; 1 is fastest for small networks; 0: 1 or 2, measured at the start."""
    explain: bool = setting(False, on_resume=True)
    """Print how the agent is wired (who writes and who reads each entry), and end before training."""

    def make_env(self, num_envs: int, seed: int, workers: int = 1) -> envs.VectorEnv:
        """The environment of these settings; a recipe with another kind of environment overrides this."""
        make, keywords, here = self.env_id, dict(self.env), Path.cwd()
        modules = [name.split()[1].partition(":")[0] for name in self.imports()]
        if self.wrapper is not None or any([look_in(here, module) for module in modules]):
            by_gymnasium = not self.env_id.startswith(("dm_control/", "dmc:"))
            inside = {k: keywords.pop(k) for k in ("max_episode_steps",) if by_gymnasium and k in keywords}
            make = partial(made_here, self.env_id, self.wrapper, modules, here, **inside)
            vars(make)["__qualname__"] = self.env_id  # the name that messages and the replay use
        keywords |= {"num_envs": num_envs, "seed": seed, "workers": workers, "action_repeat": self.action_repeat}
        keywords |= {"env_timeout": self.env_timeout, "restart_workers": self.restart_workers}
        return envs.make(make, **keywords)

    def imports(self) -> list[str]:
        """The settings that name a module to import, as flags."""
        named = ":" in self.env_id and not self.env_id.startswith("dmc:")
        given = [f"--env-id {self.env_id}"] if named else []
        return [*given, f"--wrapper {self.wrapper}"] if self.wrapper else given


def placed(args: RunArgs) -> torch.device:
    """The device of these settings. In ``with placed(args):`` tensors and modules are made there.

    Raises:
        UserError: there is no GPU and ``--device cuda`` asks for one.
    """
    if args.device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: PyTorch finds no GPU here; --device auto takes the CPU then")
    return torch.device("cuda" if args.device != "cpu" and torch.cuda.is_available() else "cpu")


def imported(name: str) -> Callable[[gym.Env], gym.Env]:
    """The function ``module:function``.

    Raises:
        UserError: there is no such module, or no such function in it.
    """
    module, colon, function = name.partition(":")
    if not (module and colon and function):
        raise UserError(f"--wrapper {name}: give module:function, as in my_module:wrap")
    try:
        found: Any = vars(importlib.import_module(module)).get(function)
    except ModuleNotFoundError as error:
        if error.name != module:
            raise
        raise UserError(f"--wrapper {name}: no module '{module}', neither here nor installed") from None
    if not callable(found):
        raise UserError(f"--wrapper {name}: {'it is no function' if found else 'the module has no ' + repr(function)}")
    return cast(Any, found)


def made_here(env_id: str, wrapper: str | None, modules: list[str], here: Path, **kwargs: Any) -> gym.Env:
    """One environment, of modules that may lie in the folder ``here``; in worker processes, too."""
    for module in modules:
        look_in(here, module)
    env = envs.make_one(env_id, **kwargs)
    if wrapper is None:
        return env
    wrap = imported(wrapper)
    try:
        inspect.signature(wrap).bind(env)
    except TypeError as error:
        raise UserError(f"--wrapper {wrapper} is called with one environment, this cannot be: {error}") from None
    except ValueError:  # built in
        pass
    wrapped = wrap(env)
    if wrapped is None:
        raise UserError(f"--wrapper {wrapper} returned None: return the wrapped environment")
    return wrapped


def told(args_class: type[RunArgs], name: str) -> dict[str, Any]:
    """What :func:`setting` says of a field, also where a class below overrides its default."""
    fields = [vars(base).get("__dataclass_fields__", {}).get(name) for base in reversed(args_class.__mro__)]
    return {key: value for found in fields if found is not None for key, value in found.metadata.items()}


def free_on_resume(args_class: type[RunArgs]) -> list[str]:
    """The settings that a resumed run may change."""
    return [f.name for f in dataclasses.fields(args_class) if told(args_class, f.name).get("on_resume")]


def flag(name: str, value: Any = "") -> str:
    """The setting as it is written on the command line."""
    text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return f"--{name.replace('_', '-')} {text}".rstrip()


def check(args: RunArgs) -> None:
    """A UserError for a number that no run can have."""
    for name, value in vars(args).items():
        bounds = told(type(args), name)
        low, high, above = (bounds.get(key, d) for key, d in (("low", -(2**62)), ("high", 2**62), ("above", -math.inf)))
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            if isinstance(number, float) and not math.isfinite(number):
                raise UserError(f"{flag(name, number)}: give a finite number")
            if number <= above:
                raise UserError(f"{flag(name, number)}: give a number above {above:g}")
            if not low <= number <= high:
                bound = f"at least {low:g}" if number < low else f"at most {high:g}"
                raise UserError(f"{flag(name, number)}: give {bound}")


def of_type(value: Any, hint: Any) -> Any:
    """A setting from JSON in the type of its field.

    Raises:
        TypeError: it has another type.
    """
    origin, kinds = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return of_type(value, kinds[0])
    if origin is Literal:
        fits = value in kinds
    elif origin in (typing.Union, types.UnionType):
        for kind in kinds:
            try:
                return of_type(value, kind)
            except TypeError:
                continue
        fits = False
    elif origin is tuple and isinstance(value, list | tuple):
        each = kinds[:1] * len(value) if kinds[1:] == (...,) else kinds
        if len(each) != len(value):
            raise TypeError(value)
        return tuple(of_type(x, kind) for x, kind in zip(value, each, strict=True))
    elif hint is Path and isinstance(value, str | Path):
        return Path(value)
    elif hint is float:
        fits = isinstance(value, int | float) and not isinstance(value, bool)
    elif hint is int:
        fits = isinstance(value, int) and not isinstance(value, bool)
    else:
        fits = isinstance(value, origin or hint) if isinstance(origin or hint, type) else True
    if not fits:
        raise TypeError(value)
    return value
