"""The table of versions in docs/pages/contributing.md. ``python tests/docs/test_versions.py`` writes it."""

from __future__ import annotations

import platform
import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "pages" / "contributing.md"
TABLE = re.compile(r"(?<=<!-- versions -->\n).*?(?=<!-- end of versions -->)", re.DOTALL)
tomllib = pytest.importorskip("tomllib")  # from Python 3.11 on
TOOLS = {"test", "docs", "bench"}  # extras that no user needs


def packages() -> Iterator[tuple[Requirement, str]]:
    """What pyproject.toml names, each with its extra."""
    project: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    yield Requirement(f"python{project['requires-python']}"), ""
    extras = {name: needs for name, needs in project["optional-dependencies"].items() if name not in TOOLS}
    for extra, needs in {"": project["dependencies"], **dict(sorted(extras.items()))}.items():
        yield from ((Requirement(text), extra) for text in needs)


def installed(name: str) -> str:
    """The version here, without its build; a dash if it is not installed."""
    try:
        return platform.python_version() if name == "python" else version(name).partition("+")[0]
    except PackageNotFoundError:
        return "-"


def bounds(allowed: SpecifierSet) -> str:
    """The lower bound first."""
    return ", ".join(sorted(map(str, allowed), reverse=True)) or "any"


def table() -> str:
    """The table, with the versions of this environment."""
    rows = [
        f"| `{need.name}` | {bounds(need.specifier)} | {installed(need.name)} | {extra and f'`{extra}`'} |"
        for need, extra in packages()
    ]
    return "\n".join(["| package | allowed | tested with | extra |", "|---|---|---|---|", *rows, ""])


def test_the_table_has_what_pyproject_allows_and_versions_that_it_allows() -> None:
    found = TABLE.search(PAGE.read_text(encoding="utf-8"))
    assert found is not None
    rows = [[cell.strip(" `") for cell in line.split("|")[1:-1]] for line in found[0].splitlines()[2:]]
    expected = [[need.name, bounds(need.specifier), extra] for need, extra in packages()]
    assert [[name, allowed, extra] for name, allowed, _, extra in rows] == expected, "run this file"
    for (need, _), (name, _, tested, _) in zip(packages(), rows, strict=True):
        assert tested != "-" and need.specifier.contains(tested, prereleases=True), (name, tested)


if __name__ == "__main__":
    PAGE.write_text(TABLE.sub(lambda _: table(), PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"wrote {PAGE}")
