"""``config.json`` of a run directory: recipe, settings, versions; and the recipe that it was written by."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
import os
import platform
import shlex
import subprocess
import sys
import typing
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import torch

from pgkit import __version__, files
from pgkit.cli import recipes
from pgkit.errors import UserError
from pgkit.run.args import RunArgs, free_on_resume, of_type

A = TypeVar("A", bound=RunArgs)
PACKAGES = ("torch", "torchrl", "tensordict", "numpy", "gymnasium", "mujoco", "dm-control", "shimmy")
_TEXT = (str, type(None))
_KINDS = {
    "settings": dict,
    "command": list,
    "resumed_at": list,
    "id": str,
    "may_change": list,
    "file": _TEXT,
    "environment": str,
}


def write_config(
    path: Path, args: RunArgs, recipe: str, before: dict[str, Any] | None, identity: str, environment: str
) -> None:
    """Write ``config.json``; ``before`` is that of the run that goes on, with the frames of each resume."""
    config = {
        "recipe": recipe,
        "file": recipe_file(type(args)),
        "file_sha256": digest(recipe_file(type(args))),
        "settings": dataclasses.asdict(args) | {"run_dir": path, "resume": None, "trust": False},
        "may_change": free_on_resume(type(args)),
        "command": before["command"] if before else sys.argv,
        "versions": versions(),
        "git_revision": git_revision(),
        "resumed_at": before["resumed_at"] if before else [],
        "id": identity,
        "environment": environment,
    }
    write_json(path / "config.json", config)


def read_config(path: Path) -> dict[str, Any]:
    """``config.json`` of a run directory; a UserError if there is none, or if it is damaged."""
    file = path / "config.json"
    try:
        if not file.is_file():
            raise UserError(f"{path} is not a run directory: it has no config.json")
    except OSError as error:
        raise UserError(f"{path} is not a run directory: {error.strerror}") from error
    config = read_json(file)
    if not isinstance(config, dict) or not isinstance(config.get("recipe"), str) or "settings" not in config:
        raise UserError(f"{file} is damaged: it names no recipe and settings")
    for key, kind in _KINDS.items():
        if key in config and not isinstance(config[key], kind):
            raise UserError(f"{file} is damaged: its {key} is {config[key]!r:.60}")
    if not isinstance(config["settings"].get("env_id", ""), str):
        raise UserError(f"{file} is damaged: its env_id is no text")
    return config


def write_json(path: Path, content: dict[str, Any], hashed: bool = True) -> None:
    """Write JSON, with its hash, in one step; NaN and infinity, which JSON does not have, become null."""
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in content.items()}
    plain = json.loads(json.dumps(plain, default=str))
    text = json.dumps(plain | ({"sha256": _hash(plain)} if hashed else {}), indent=2)
    with files.replacing(path) as file:
        file.write(text.encode() + b"\n")


def read_json(path: Path) -> Any:
    """A run's JSON file; a UserError if it is damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    if isinstance(content, dict) and {"sha256", "id"} & content.keys() and content.pop("sha256", "") != _hash(content):
        raise UserError(f"{path} is damaged, or was edited: its hash does not fit")
    return content


def _hash(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def recipe_file(args_class: type[RunArgs]) -> str | None:
    """The file in which a recipe defines its settings; None for a shipped one, and outside files."""
    file = vars(sys.modules[args_class.__module__]).get("__file__")
    if args_class is RunArgs or file is None or recipes.is_shipped(Path(file)):
        return None
    return str(Path(file).resolve())


def recipe_target(args_class: type[RunArgs], recipe: str = "") -> str:
    """What ``pgkit run`` takes to run this recipe again: its file, or a shipped name."""
    file = recipe_file(args_class)
    if file is None:
        return recipe or Path(vars(sys.modules[args_class.__module__]).get("__file__") or args_class.__module__).stem
    here = Path.cwd()
    return shlex.quote(str(Path(file).relative_to(here) if Path(file).is_relative_to(here) else file))


def digest(file: str | None) -> str | None:
    """The hash of a recipe's file."""
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if file and Path(file).is_file() else None


def saved_args(args_class: type[A], run_dir: Path) -> A:
    """The settings of a run, in the types of the dataclass; a UserError if they are no settings of this recipe."""
    config, hints = read_config(run_dir), typing.get_type_hints(args_class, include_extras=True)
    saved = config["settings"]
    if unknown := saved.keys() - hints.keys():
        names = ", ".join(sorted(unknown))
        raise UserError(f"{run_dir} is a run of {config['recipe']}; this recipe has no setting {names}")
    typed = {}
    for name, value in (saved | {"run_dir": str(run_dir), "resume": str(run_dir), "trust": False}).items():
        try:
            typed[name] = of_type(value, hints[name])
        except TypeError:
            raise UserError(f"{run_dir / 'config.json'} is damaged: its {name} is {value!r:.60}") from None
    return dataclasses.replace(args_class(), **typed)


def check_imports(saved: RunArgs, trust: bool, *given: str) -> None:
    """A UserError where a run directory names a module to import that the user neither gives nor trusts."""
    for named in saved.imports():
        if not trust and named not in given:
            raise UserError(f"{saved.run_dir} names code to import, {named}: give that again, or --trust the directory")


def as_resumed(args: RunArgs, run_dir: Path) -> None:
    """Gives ``args`` the settings of the run that goes on, as the command line does; a warning names other values."""
    saved, free = saved_args(type(args), run_dir), {*free_on_resume(type(args)), "run_dir"}
    check_imports(saved, args.trust, *args.imports())
    kept = {name: value for name, value in vars(saved).items() if name not in free and vars(args)[name] != value}
    if kept:
        names = ", ".join(f"{name}={value!r}" for name, value in sorted(kept.items()))
        logging.getLogger("pgkit").warning("the resumed run keeps its own settings: %s", names)
    for name, value in kept.items():
        setattr(args, name, value)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that can change a run's numbers."""
    found = {"python": platform.python_version(), "pgkit": __version__}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {**found, "torch": str(torch.__version__)}  # with its build (+cpu, +cu130), which a wheel may not name


def git_revision() -> str | None:
    """Revision of the working directory, ``-dirty`` with uncommitted changes; None outside a repository."""
    safe = ["-c", "core.fsmonitor=false"]  # a program that a repository's own settings may name
    command = ["git", *safe, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, env=os.environ)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None
