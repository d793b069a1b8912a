"""Where the recipes are."""

import ast
import difflib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from pgkit.cli.beside import look_beside
from pgkit.errors import UserError


def recipes_dir() -> Path:
    """The shipped recipes: inside the installed package, or beside it in a source checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "recipes"
    return inside if inside.is_dir() else package.parent / "recipes"


def is_shipped(file: Path) -> bool:
    """Whether it is one of the shipped recipes."""
    return file.resolve().parent == recipes_dir().resolve()


def names() -> list[str]:
    """Names of the shipped recipes, each one file."""
    return sorted(path.stem for path in recipes_dir().glob("*.py") if not path.name.startswith("_"))


def variants() -> dict[str, tuple[str, dict[str, Any]]]:
    """Names that stand for a recipe with other settings: ``name -> (recipe, settings)``, from its ``VARIANTS``.

    The recipes are read, not run: ``VARIANTS`` is written as a dict of ``dict(setting=value, ...)``.
    """
    found = {}
    for recipe in names():
        for node in ast.parse((recipes_dir() / f"{recipe}.py").read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "VARIANTS":
                entries: Any = node.value
                for name, call in zip(entries.keys, entries.values, strict=True):
                    settings = {keyword.arg: ast.literal_eval(keyword.value) for keyword in call.keywords}
                    found[ast.literal_eval(name)] = (recipe, settings)
    return dict(sorted(found.items()))


def first_line(path: Path) -> str:
    """The first line of a recipe's docstring; the recipe is not run."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def find(recipe: str) -> Path:
    """The file of a recipe given as a shipped name (``ppo``), a variant's (``redq``), or a path (``mine.py``)."""
    if recipe.endswith(".py") or "/" in recipe:
        path = Path(recipe)
        if not path.is_file():
            raise UserError(f"no recipe file {recipe}; copy a shipped one with: pgkit cp ppo {recipe}")
        return path
    if recipe not in (known := names()):
        named = variants()
        if recipe in named:
            return recipes_dir() / f"{named[recipe][0]}.py"
        known = sorted([*known, *named])
        if Path(f"{recipe}.py").is_file():
            raise UserError(f"no recipe named {recipe}; the file here is {recipe}.py")
        close = ", ".join(difflib.get_close_matches(recipe, known, cutoff=0.3) or known)
        raise UserError(f"no recipe named {recipe}; nearest: {close} (pgkit ls lists all; a file ends in .py)")
    return recipes_dir() / f"{recipe}.py"


def load(path: Path) -> ModuleType:
    """The recipe in this file, imported.

    Raises:
        UserError: it has no ``main`` and ``Args``.
    """
    path = path.resolve()
    look_beside(path)
    if is_shipped(path) and str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # workers import the recipe's classes by its name
    name = path.stem if _own_name(path) else f"{path.stem}_recipe"
    spec: Any = importlib.util.spec_from_file_location(name, path)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    if missing := [x for x in ("main", "Args") if x not in vars(module)]:
        raise UserError(
            f"{path} has no {' and no '.join(missing)}: a recipe has a class Args and a function main(args)"
        )
    return module


def _own_name(path: Path) -> bool:
    """Whether no other module has the name of this file."""
    try:
        spec = importlib.util.find_spec(path.stem)
    except (ValueError, ImportError):  # half a module, or a name with a dot
        return False
    return spec is None or spec.origin == str(path)
