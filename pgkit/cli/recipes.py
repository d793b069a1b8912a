"""Where the recipes are."""

import ast
import difflib
from pathlib import Path

from pgkit.errors import UserError


def recipes_dir() -> Path:
    """The shipped recipes: inside the installed package, or beside it in a source checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "recipes"
    return inside if inside.is_dir() else package.parent / "recipes"


def names() -> list[str]:
    """Names of the shipped recipes."""
    return sorted(path.stem for path in recipes_dir().glob("*.py") if not path.name.startswith("_"))


def first_line(path: Path) -> str:
    """The first line of a recipe's docstring; the recipe is not run."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def find(recipe: str) -> Path:
    """The file of a recipe given as a shipped name (``ppo``) or a path (``mine.py``)."""
    if recipe.endswith(".py") or "/" in recipe:
        path = Path(recipe)
        if not path.is_file():
            raise UserError(f"no recipe file {recipe}; copy a shipped one with: pgkit cp ppo {recipe}")
        return path
    if recipe not in names():
        close = ", ".join(difflib.get_close_matches(recipe, names(), cutoff=0.3) or names())
        raise UserError(f"no recipe named {recipe}; nearest: {close} (pgkit ls lists all; a file ends in .py)")
    return recipes_dir() / f"{recipe}.py"
