"""``pgkit ls / cp / run / eval / export / plot``. Heavy imports wait until a command needs them."""

import argparse
import os
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from pgkit import __version__
from pgkit.cli import policies, recipes, studies
from pgkit.cli.beside import look_beside
from pgkit.cli.exits import exits
from pgkit.errors import UserError


class Parser(argparse.ArgumentParser):
    """Says what is wrong with the command line in one line."""

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command: exit 2 and one line on a user's error, 3 on divergence, 130 on Ctrl-C."""
    _wait_quietly()
    with exits():
        args, flags = parser().parse_known_args(argv)
        if flags and not args.takes_flags:
            raise UserError(f"unrecognized arguments: {' '.join(flags)} (see pgkit --help)")
        args.flags = flags or args.flags
        args.command(args)


def _wait_quietly() -> None:
    """Threads that wait for each other sleep: by default they spin, which starves a second run on the same cores.

    OpenMP reads it when torch loads.
    """
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"} & os.environ.keys():
        os.environ["OMP_WAIT_POLICY"] = "passive"


def parser() -> Parser:
    """The command line's grammar."""
    top = Parser(prog="pgkit", description="Policy-gradient building blocks on TorchRL.", allow_abbrev=False)
    top.add_argument("--version", action="version", version=f"pgkit {__version__}")
    top.set_defaults(takes_flags=False, flags=[])
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("ls", help="list the recipes")
    command.set_defaults(command=list_recipes)

    command = commands.add_parser("cp", help="copy a recipe, to edit it")
    command.add_argument("recipe", help="a name that pgkit ls shows")
    command.add_argument("file", type=Path, help="where to; a file that exists is not overwritten")
    command.set_defaults(command=copy_recipe)

    command = commands.add_parser("run", help="train with a recipe", usage="pgkit run RECIPE [FLAGS]")
    command.add_argument("recipe", help="a name that pgkit ls shows, or a file; RECIPE --help lists its flags")
    command.add_argument("flags", nargs=argparse.REMAINDER, help="the recipe's own").required = False
    command.set_defaults(command=run_recipe)

    policies.add(commands, positive, seed)

    command = commands.add_parser("plot", help="draw the learning curves of runs; seeds are averaged")
    command.add_argument("run_dirs", type=Path, nargs="+", metavar="RUN_DIR")
    command.add_argument(
        "-o", "--out", type=Path, help="image file (default: curve.png in RUN_DIR, or curves.png for several)"
    )
    command.add_argument(
        "--x", choices=["frames", "wall"], default="frames", help="axis: frames, or minutes of training"
    )
    command.set_defaults(command=plot_runs)
    studies.add(commands, positive)
    return top


def positive(text: str) -> int:
    """A whole number from 1 to a million."""
    if not 1 <= (value := int(text)) <= 10**6:
        raise argparse.ArgumentTypeError(f"{text:.30} is not a positive number up to 1,000,000")
    return value


def seed(text: str) -> int:
    """A seed of environments."""
    if not 0 <= (value := int(text)) < 2**62:
        raise argparse.ArgumentTypeError(f"{text:.30}: give a whole number from 0 to 2^62")
    return value


def list_recipes(_: argparse.Namespace) -> None:
    lines = {name: recipes.first_line(recipes.find(name)) for name in recipes.names()}
    for name, (recipe, settings) in recipes.variants().items():
        flags = (f"--{key.replace('_', '-')} {value}" for key, value in settings.items())
        lines[name] = f"{recipe} {' '.join(flags)}"
    for name in sorted(lines):
        print(f"{name:<12} {lines[name]}")


def copy_recipe(args: argparse.Namespace) -> None:
    source, target = recipes.find(args.recipe), args.file
    try:
        if target.is_dir():
            target = target / source.name
        if target.suffix != ".py":
            raise UserError(f"{target} is no name for a recipe: give one that ends in .py")
        if not target.parent.is_dir():
            raise UserError(f"no directory {target.parent} to copy into")
        with target.open("xb") as file:  # exclusive: a link that waits there is not followed
            file.write(source.read_bytes())
    except FileExistsError:
        raise UserError(f"{target} exists and is not overwritten; give another name") from None
    except OSError as error:
        raise UserError(f"{target} cannot be written: {error.strerror}") from error
    variant = f" --variant {args.recipe}" if args.recipe in recipes.variants() else ""
    print(f"copied to {target}; train with: pgkit run {target}{variant}")


def run_recipe(args: argparse.Namespace) -> None:
    path = recipes.find(args.recipe)
    if not recipes.is_shipped(path):  # as `python FILE` runs it, but what lies beside it hides no other module
        sys.argv = [args.recipe, *args.flags]
        look_beside(path)
        runpy.run_path(str(path), run_name="__main__")
        return
    recipe = recipes.load(path)
    variant = ["--variant", args.recipe] if args.recipe in recipes.variants() else []
    from pgkit import run

    settings = {name.lower(): vars(recipe).get(name) for name in ("PRESETS", "VARIANTS")}
    run.launch(recipe.main, recipe.Args, argv=[*variant, *args.flags], **settings)


def plot_runs(args: argparse.Namespace) -> None:
    from pgkit import run

    out = args.out or (args.run_dirs[0] / "curve.png" if len(args.run_dirs) == 1 else Path("curves.png"))
    print(f"wrote {run.plot(args.run_dirs, out, args.x)}")
