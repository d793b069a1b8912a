"""The reference pages show every public name."""

import importlib
from pathlib import Path
from types import ModuleType

import pytest

PAGES = sorted((Path(__file__).parents[2] / "docs" / "pages" / "api").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_name_that_its_file_has_too_is_shown_by_itself(page: Path) -> None:
    """mkdocstrings takes ``pgkit.envs.make`` for the file ``make.py`` and leaves out the function."""
    package = importlib.import_module(f"pgkit.{page.stem}")
    hidden = [name for name in package.__all__ if (Path(str(package.__file__)).parent / f"{name}.py").exists()]
    assert not any(isinstance(vars(package)[name], ModuleType) for name in package.__all__)
    shown = page.read_text(encoding="utf-8").split()
    assert f"pgkit.{page.stem}" in shown
    assert {f"pgkit.{page.stem}.{name}.{name}" for name in hidden} == {x for x in shown if x.count(".") > 1}
