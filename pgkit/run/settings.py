"""From the command line to a recipe's ``main``."""

from __future__ import annotations

import argparse
import ast
import contextlib
import dataclasses
import difflib
import io
import itertools
import logging
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, TypeVar

import tyro

from pgkit.cli.exits import exits
from pgkit.errors import UserError
from pgkit.run import config, directory
from pgkit.run.args import RunArgs, check, flag, free_on_resume, told

__all__ = ["RunArgs", "check", "launch", "parse"]
A = TypeVar("A", bound=RunArgs)
Presets = Mapping[str, Mapping[str, Any]]


def launch(
    main: Callable[[A], None],
    args_class: type[A],
    presets: Presets | None = None,
    argv: Sequence[str] | None = None,
    variants: Presets | None = None,
) -> None:
    """Parse the flags and call ``main(args)``: exit 2 and one line on a UserError, 3 on divergence, 130 on Ctrl-C.

    Args:
        presets: env id pattern (as in a shell: ``dm_control/*``) -> settings; the first match is used.
        argv: the flags, without the program's name (default: ``sys.argv[1:]``).
        variants: name -> settings that the flag ``--variant NAME`` starts from; the preset comes on top.
    """
    logging.basicConfig(format="%(message)s")  # to stderr
    logging.getLogger("pgkit").setLevel(logging.INFO)
    with exits():
        main(parse(args_class, presets or {}, sys.argv[1:] if argv is None else argv, variants or {}))


def parse(args_class: type[A], presets: Presets, argv: Sequence[str], variants: Presets | None = None) -> A:
    """Settings, each over the one before: dataclass defaults, the variant, the env's preset, flags.

    A resumed run's settings take the place of the first three.
    """
    argv, keywords = _env_keywords(list(_whole_numbers(args_class, argv)))
    _check_names(args_class, argv)
    peek = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("env_id", "wrapper", "resume", "run_dir", "variant"):
        peek.add_argument(f"--{name.replace('_', '-')}", f"--{name}", nargs="?")
    for name in ("resume_if_possible", "trust"):
        peek.add_argument(f"--{name.replace('_', '-')}", f"--{name}", action="store_true")
    given = peek.parse_known_args(argv)[0]
    if given.resume_if_possible and not given.resume and given.run_dir:
        given.resume = given.run_dir if directory.can_resume(Path(given.run_dir)) else None
    if given.resume:
        base = config.saved_args(args_class, directory.run_of(Path(given.resume)))
        config.check_imports(base, given.trust, f"--env-id {given.env_id}", f"--wrapper {given.wrapper}")
        args = _flags(args_class, dataclasses.replace(base, resume=Path(given.resume)), argv)
        args.env = {**base.env, **keywords}
        _check_resumed(base, args)
        return args
    defaults = args_class()
    name, variant = _variant(variants or {}, given.variant)
    pattern, preset = first_match(presets, given.env_id or defaults.env_id)
    base = dataclasses.replace(defaults, **{**variant, **preset})
    args = _flags(args_class, dataclasses.replace(base, env_id=given.env_id or base.env_id), argv)
    args.env = {**base.env, **keywords}
    for title, chosen in ((f"variant {name}", variant), (f"preset {pattern}", preset)):
        if shown := [f"{key}={value}" for key, value in chosen.items() if vars(args)[key] == value]:
            print(f"{title}: {' '.join(shown)}")
    return args


def _flags(args_class: type[A], base: A, argv: Sequence[str]) -> A:
    """The flags over ``base``; a UserError says in one line what tyro says in a box, its only way."""
    about = (
        f"{_first_line(args_class)} The defaults shown are those for --env-id {base.env_id}. "
        "--env.KEYWORD VALUE passes a keyword to the environment."
    )
    box = io.StringIO()
    program = _program(args_class)
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(args_class, default=base, args=argv, prog=program, description=about)
    except SystemExit as end:
        if not end.code:
            raise
    lines = [line.strip("│| ") for line in box.getvalue().splitlines()[1:]]  # without the title
    parts = [list(part) for is_text, part in itertools.groupby(lines, lambda x: bool(x.strip("─-╰╯+"))) if is_text]
    message = " ".join(parts[0])
    raise UserError(f"{message} (see {program} --help)")


def _env_keywords(argv: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """The flags without ``--env.KEYWORD VALUE``, and those; a value that reads as Python is one (True, 500, 0.1)."""
    rest: list[str] = []
    found: dict[str, Any] = {}
    words = iter(argv)
    for word in words:
        if not word.startswith("--env."):
            rest.append(word)
            continue
        name, equals, value = word.removeprefix("--env.").partition("=")
        value = value if equals else next(words, "--")
        if not name or value.startswith("--"):
            raise UserError(f"{word}: give a value, as in --env.continuous True")
        with contextlib.suppress(ValueError, SyntaxError):
            value = ast.literal_eval(value)
        name = name.replace("-", "_")
        if name in ("num_envs", "seed", "workers", "action_repeat"):
            raise UserError(f"{word.partition('=')[0]}: the run gives that to the environment, {flag(name, value)}")
        found[name] = value
    return rest, found


def _check_names(args_class: type[RunArgs], argv: Sequence[str]) -> None:
    """A UserError for a flag that the recipe does not have, with the nearest."""
    hints = typing.get_type_hints(args_class)
    names = {name.replace("_", "-") for name in hints.keys() - {"env"}}
    known = names | {f"no-{name}" for name in names if hints[name.replace("-", "_")] is bool} | {"help"}
    see = f"(see {_program(args_class)} --help)"
    if argv and not argv[0].startswith("-"):
        raise UserError(f"Unrecognized options: {argv[0]}; did you mean --env-id {argv[0]}? {see}")
    for word in argv:
        name = word[2:].partition("=")[0].replace("_", "-")
        if word.startswith("--") and name not in known:
            initials = [x for x in sorted(names) if "".join(part[0] for part in x.split("-")) == name]
            close = [*initials, *(x for x in difflib.get_close_matches(name, names) if x not in initials)]
            close = close or [x for x in sorted(names) if name and name in x.split("-")]
            nearest = f"; the nearest are {', '.join(f'--{x}' for x in close)}" if close else ""
            raise UserError(f"Unrecognized options: --{name}{nearest} {see}")


def _whole_numbers(args_class: type[RunArgs], argv: Sequence[str]) -> Iterator[str]:
    """The flags, with ``1e6`` written out where a flag takes whole numbers."""
    hints, kinds = typing.get_type_hints(args_class), ()
    for text in argv:
        if text.startswith("--"):
            hint = hints.get(text.removeprefix("--").partition("=")[0].replace("-", "_"))
            kinds = typing.get_args(hint) or (hint,)
        start, equals, number = text.rpartition("=") if text.startswith("--") else ("", "", text)
        if int in kinds and float not in kinds and "e" in number.lower():
            with contextlib.suppress(ValueError, OverflowError):
                text = f"{start}{equals}{float(number):.0f}" if float(number).is_integer() else text
        yield text


def _variant(variants: Presets, name: str | None) -> tuple[str | None, Mapping[str, Any]]:
    if name and name not in variants:
        raise UserError(f"--variant {name}: this recipe has {', '.join(variants) or 'none'}")
    return name, variants[name] if name else {}


def _first_line(args_class: type[RunArgs]) -> str:
    """The first line of the recipe's module docstring."""
    return (sys.modules[args_class.__module__].__doc__ or "").strip().partition("\n")[0]


def _program(args_class: type[RunArgs]) -> str:
    return f"pgkit run {config.recipe_target(args_class)}"


def first_match(presets: Presets, env_id: str) -> tuple[str, Mapping[str, Any]]:
    """The first pattern that fits the env id, and its settings; empty if none does.

    ``HalfCheetah``, which means its latest version, fits ``HalfCheetah-*``.
    """
    ids = (env_id, f"{env_id}-")
    fitting = ((pattern, values) for pattern, values in presets.items() if any(fnmatchcase(x, pattern) for x in ids))
    return next(fitting, ("", {}))


def _check_resumed(saved: RunArgs, args: RunArgs) -> None:
    for name, why in {"env_id": "that run trains on", "run_dir": "a resumed run goes on in"}.items():
        now, before = vars(args)[name], vars(saved)[name]
        if now != before:
            raise UserError(f"{flag(name, now)}: {why} {before}")
    free = free_on_resume(type(args))
    for field in dataclasses.fields(args):
        name, mine, kept = field.name, vars(args)[field.name], vars(saved)[field.name]
        if name not in free and mine != kept:
            raise UserError(f"{flag(name, mine)}: a resumed run keeps its own, {kept}; another value needs a new run")
        if mine and (other := told(type(args), name).get("follows")):
            now, before = vars(args)[other], vars(saved)[other]
            if now != before:
                print(f"{flag(name)} ends at {now:,} frames, no longer at {before:,}: it jumps where the run goes on")
