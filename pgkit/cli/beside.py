"""Modules of the user's own folders: found where they are asked for, and hiding no installed one."""

from __future__ import annotations

import ast
import importlib.util
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any


class Beside:
    """Finds some modules in a folder, and no others. Python asks it last."""

    def __init__(self, folder: Path, names: set[str]) -> None:
        self.folder, self.names = folder, names

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """The module's spec, if it is one of those."""
        return PathFinder.find_spec(name, [str(self.folder)]) if path is None and name in self.names else None


def look_beside(file: Path) -> None:
    """Lets a recipe's file import the modules in its folder, if it does; in worker processes, too."""
    folder = file.resolve().parent
    if any(importlib.util.find_spec(name) is None for name in _imported(folder, file)) and str(folder) not in sys.path:
        sys.path.append(str(folder))


def look_in(folder: Path, module: str) -> bool:
    """Lets this process import a module from a folder; returns whether it lies there and nowhere else."""
    name = module.partition(".")[0]
    known = [x for x in sys.meta_path if isinstance(x, Beside) and x.folder == folder and name in x.names]
    file = _lies_in(folder, name)
    if file and not known and importlib.util.find_spec(name) is None:
        known = [Beside(folder, {name} | _imported(folder, file))]
        sys.meta_path.extend(known)
    return bool(known)


def _imported(folder: Path, file: Path) -> set[str]:
    """The modules in the folder that a file imports, and those that these import."""
    found: set[str] = set()
    asked = [file]
    while asked:
        tree = ast.parse(asked.pop().read_text(encoding="utf-8"))
        names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
        names |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
        for name in {name.partition(".")[0] for name in names} - found:
            if here := _lies_in(folder, name):
                found.add(name)
                asked.append(here)
    return found


def _lies_in(folder: Path, name: str) -> Path | None:
    files = (folder / f"{name}.py", folder / name / "__init__.py")
    return next((file for file in files if name.isidentifier() and file.is_file()), None)
