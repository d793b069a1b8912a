"""The flags that every recipe has, and the way from the command line to a recipe's ``main``."""

import argparse
import contextlib
import dataclasses
import io
import itertools
import json
import logging
import math
import shlex
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, TypeVar

from pgkit.errors import UserError


@dataclass
class RunArgs:
    """Settings of a run; a recipe's ``Args`` derives from it and adds the algorithm's own."""

    env_id: str = "CartPole-v1"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    seed: int = 1
    """Seeds the networks, the envs and the order of minibatches."""
    total_frames: int = 100_000
    """Env steps to train for, all envs together."""
    num_envs: int = 8
    """Envs stepped side by side."""
    workers: int = 1
    """Processes that the envs are spread over; the numbers stay the same."""
    run_dir: Path | None = None
    """Where to write the run (default: runs/{env}__{recipe}__{seed}__{time})."""
    eval_every: int = 50_000
    """Evaluate and save a checkpoint every so many frames; 0 = only at the end."""
    eval_episodes: int = 10
    """Whole episodes, with deterministic actions, in each evaluation."""
    compile: Literal["auto", "on", "off"] = "auto"
    """Compile the update into one graph; auto: when the run is long enough to win the compile time back."""
    resume: Path | None = None
    """Run directory to go on with, by its own settings: only the length, evaluation, logging, workers, threads and
    compilation may be given anew."""
    threads: int = 1
    """Threads that PyTorch uses in this process; 1 is fastest for small networks."""
    explain: bool = False
    """Print how the agent is wired (who writes and who reads each entry), and end before training."""


# what no run can have, for the settings that a recipe may have under these names: (least, most)
_BOUNDS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("total_frames", "num_envs", "workers", "eval_episodes", "threads"), (1, math.inf)),
    **dict.fromkeys(("steps", "epochs", "minibatch_size", "batch_size", "n_step", "buffer_size"), (1, math.inf)),
    **dict.fromkeys(("actor_delay", "action_repeat", "log_every", "num_critics", "atoms", "bins"), (1, math.inf)),
    **dict.fromkeys(("hidden", "critic_hidden", "sequence_length", "memory_size"), (1, math.inf)),
    **dict.fromkeys(("cg_steps", "critic_epochs"), (1, math.inf)),
    **dict.fromkeys(("old_rollouts", "delay", "backtracks", "damping", "max_kl", "kl_target"), (0, math.inf)),
    **dict.fromkeys(("beta", "priority_alpha", "priority_beta", "critic_coeff", "target_kl"), (0, math.inf)),
    **dict.fromkeys(("exploration_noise", "policy_noise", "noise_clip", "noise", "rho_thresh"), (0, math.inf)),
    **dict.fromkeys(("c_thresh", "epsilon_frames"), (0, math.inf)),
    "seed": (0, 2**62),
    **dict.fromkeys(("eval_every", "random_frames", "updates_per_step"), (0, math.inf)),
    **dict.fromkeys(("learning_rate", "q_learning_rate", "alpha_learning_rate", "clip_epsilon"), (0, math.inf)),
    **dict.fromkeys(("gamma", "lmbda", "tau", "epsilon_end"), (0, 1)),
    "alpha": (0, math.inf),
    "beta1": (0, 0.9999),
    "dropout": (0, 0.99),
    "alpha_init": (1e-8, math.inf),
}
_ABOVE_ZERO = ("max_grad_norm", "relaxation")

# what a resumed run may change: how long, how fast and how closely watched it goes on
_FREE_ON_RESUME = {
    "total_frames", "eval_every", "eval_episodes", "log_every", "workers", "threads", "compile", "save_buffer",
    "buffer_dir", "explain", "resume",
}  # fmt: skip

A = TypeVar("A", bound=RunArgs)
Presets = Mapping[str, Mapping[str, Any]]


def launch(
    main: Callable[[A], None],
    args_class: type[A],
    presets: Presets | None = None,
    argv: Sequence[str] | None = None,
    variants: Presets | None = None,
) -> None:
    """Parse the flags and call ``main(args)``: exit 2 and one line on a UserError, 130 on Ctrl-C.

    Args:
        presets: env id pattern (as in a shell: ``dm_control/*``) -> settings; the first match is used.
        argv: the flags, without the program's name (default: ``sys.argv[1:]``).
        variants: name -> settings that the flag ``--variant NAME`` starts from; the preset comes on top.
    """
    logging.basicConfig(format="%(message)s")  # to stderr
    logging.getLogger("pgkit").setLevel(logging.INFO)
    try:
        main(parse(args_class, presets or {}, sys.argv[1:] if argv is None else argv, variants or {}))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def parse(args_class: type[A], presets: Presets, argv: Sequence[str], variants: Presets | None = None) -> A:
    """Settings, each over the one before: dataclass defaults, the variant, the env's preset, flags.

    A resumed run's settings take the place of the first three.
    """
    peek = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    peek.add_argument("--env-id", "--env_id", nargs="?")
    peek.add_argument("--resume", nargs="?", type=Path)
    if variants:
        peek.add_argument("--variant", nargs="?")
    given = peek.parse_known_args(argv)[0]
    defaults = args_class()
    name, variant = _variant(variants or {}, getattr(given, "variant", None))
    if given.resume:
        pattern, preset, variant = "", _saved_settings(args_class, given.resume), {}
    else:
        pattern, preset = first_match(presets, given.env_id or defaults.env_id)
    base = dataclasses.replace(defaults, **{**variant, **preset})
    args = _flags(args_class, base, given.env_id or base.env_id, list(_whole_numbers(args_class, argv)))
    if given.resume:
        _check_resumed(base, args)
    else:
        for title, chosen in ((f"variant {name}", variant), (f"preset {pattern}", preset)):
            if shown := [f"{key}={value}" for key, value in chosen.items() if getattr(args, key) == value]:
                print(f"{title}: {' '.join(shown)}")
    return args


def _flags(args_class: type[A], base: A, env_id: str, argv: Sequence[str]) -> A:
    """The flags over ``base``; a UserError says in one line what tyro says in a box."""
    import tyro

    about = f"{main_doc(args_class)} The defaults shown are those for --env-id {env_id}."
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(args_class, default=base, args=argv, prog=_program(), description=about)
    except SystemExit as end:
        if not end.code:
            raise
    lines = [line.strip("│ ") for line in box.getvalue().splitlines()[1:]]  # without the title
    parts = [list(part) for is_text, part in itertools.groupby(lines, lambda line: bool(line.strip("─-╰╯"))) if is_text]
    message = " ".join(parts[0])
    if message.startswith("Unrecognized"):
        similar = [line.split()[0] for part in parts[1:] for line in part if line.startswith("--")]
        if argv and not argv[0].startswith("-"):
            message += f"; did you mean --env-id {argv[0]}?"
        elif similar:
            message += f"; the nearest are {', '.join(similar)}"
    raise UserError(f"{message} (see {_program()} --help)")


def _whole_numbers(args_class: type[RunArgs], argv: Sequence[str]) -> Iterator[str]:
    """The flags, with ``1e6`` written out where a flag takes whole numbers."""
    hints = typing.get_type_hints(args_class)
    for before, text in zip(["", *argv], argv, strict=False):
        kinds = typing.get_args(hint := hints.get(before.removeprefix("--").replace("-", "_"))) or (hint,)
        if int in kinds and float not in kinds and "e" in text.lower():
            with contextlib.suppress(ValueError):
                text = f"{float(text):.0f}" if float(text).is_integer() else text
        yield text


def _variant(variants: Presets, name: str | None) -> tuple[str | None, Mapping[str, Any]]:
    if name and name not in variants:
        raise UserError(f"--variant {name}: this recipe has {', '.join(variants)}")
    return name, variants[name] if name else {}


def check(args: RunArgs) -> None:
    """A UserError for a number that no run can have."""
    for name, value in vars(args).items():
        least, most = _BOUNDS.get(name, (-math.inf, math.inf))
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise UserError(f"--{name.replace('_', '-')} {number}: give a finite number")
            if name in _ABOVE_ZERO and isinstance(number, int | float) and number <= 0:
                raise UserError(f"--{name.replace('_', '-')} {number}: give a number above 0")
            if isinstance(number, int | float) and not least <= number <= most:
                bound = f"at least {least:g}" if number < least else f"at most {most:g}"
                raise UserError(f"--{name.replace('_', '-')} {number}: give {bound}")


def main_doc(args_class: type[RunArgs]) -> str:
    """The first line of the recipe's module docstring."""
    module = sys.modules.get(args_class.__module__)
    return next(iter((getattr(module, "__doc__", None) or "").strip().splitlines()), "")


def recipe_target(recipe: str) -> str:
    """What ``pgkit run`` takes to run this recipe again: the script running now, or a shipped name."""
    return shlex.quote(sys.argv[0]) if sys.argv[0].endswith(".py") else recipe


def _program() -> str:
    return f"pgkit run {recipe_target(Path(sys.argv[0]).name)}"


def first_match(presets: Presets, env_id: str) -> tuple[str, Mapping[str, Any]]:
    """The first pattern that fits the env id, and its settings; empty if none does.

    ``HalfCheetah``, which means its latest version, fits ``HalfCheetah-*``.
    """
    ids = (env_id, f"{env_id}-")
    fitting = ((pattern, values) for pattern, values in presets.items() if any(fnmatchcase(x, pattern) for x in ids))
    return next(fitting, ("", {}))


def _saved_settings(args_class: type[RunArgs], run_dir: Path) -> dict[str, Any]:
    """The settings in ``run_dir/config.json``, back in the types of the dataclass."""
    path = run_dir / "config.json"
    if not path.is_file():
        raise UserError(f"--resume {run_dir}: no config.json there, so it is not a run directory")
    config, hints = read_json(path), typing.get_type_hints(args_class)
    saved = config["settings"]
    if unknown := saved.keys() - hints.keys():
        names = ", ".join(sorted(unknown))
        raise UserError(f"--resume {run_dir}: that is a run of {config['recipe']}; this recipe has no setting {names}")
    saved |= {"run_dir": str(run_dir), "resume": str(run_dir)}
    return {name: _typed(value, hints[name]) for name, value in saved.items()}


def as_resumed(args: RunArgs, run_dir: Path) -> None:
    """Gives ``args`` the settings of the run that goes on, as the command line does; a warning names other values."""
    saved = _saved_settings(type(args), run_dir)
    kept = {name: saved[name] for name in saved.keys() - _FREE_ON_RESUME if getattr(args, name) != saved[name]}
    if getattr(args, "anneal", False):
        kept.pop("learning_rate", None)
    kept.pop("run_dir", None)
    if kept:
        names = ", ".join(f"{name}={value!r}" for name, value in sorted(kept.items()))
        logging.getLogger("pgkit").warning("the resumed run keeps its own settings: %s", names)
    for name, value in kept.items():
        setattr(args, name, value)


def _typed(value: Any, hint: Any) -> Any:
    kinds = (hint, *typing.get_args(hint))
    if isinstance(value, str) and Path in kinds:
        return Path(value)
    is_tuple = isinstance(value, list) and any(typing.get_origin(kind) is tuple for kind in kinds)
    return tuple(value) if is_tuple else value


def read_json(path: Path) -> dict[str, Any]:
    """A run's JSON file; a UserError if it is damaged."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error


def _check_resumed(saved: RunArgs, args: RunArgs) -> None:
    for name, why in {"env_id": "that run trains on", "run_dir": "a resumed run goes on in"}.items():
        if getattr(args, name) != getattr(saved, name):
            raise UserError(f"--{name.replace('_', '-')} {getattr(args, name)}: {why} {getattr(saved, name)}")
    for field in dataclasses.fields(args):
        name, kept = field.name, getattr(saved, field.name)
        annealed = name == "learning_rate" and getattr(args, "anneal", False)
        if name not in _FREE_ON_RESUME and not annealed and getattr(args, name) != kept:
            flag = f"--{name.replace('_', '-')} {getattr(args, name)}"
            raise UserError(f"{flag}: a resumed run keeps its own, {kept}; another value needs a new run")
    if getattr(args, "anneal", False) and args.total_frames != saved.total_frames:
        frames = f"{args.total_frames:,}, no longer {saved.total_frames:,} frames"
        print(f"the learning rate anneals to zero at {frames}: it jumps where the run goes on")
