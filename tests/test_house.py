"""Who may import whom: docs/house.md as a test."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PGKIT = ROOT / "pgkit"
FREE = {"torch", "tensordict", "errors", "seams", "files", "messages"}
MAY_IMPORT = {
    "functional": set(),
    "heads": {"functional"},
    "modules": {"functional", "heads", "torchrl"},
    "advantages": {"functional", "torchrl"},
    "controllers": {"functional"},
    "losses": {"functional", "heads", "controllers", "torchrl"},
    "compiled": set(),
    "optim": set(),
    "checks": {"functional", "optim", "torchrl"},
    "updates": {"functional", "compiled", "optim", "checks", "data"},
    "data": {"torchrl"},
    "envs": {"compiled", "gymnasium", "torchrl"},
    "collectors": {"envs", "compiled", "torchrl"},
}
EVERYTHING = {"torchrl", "gymnasium", *MAY_IMPORT}
MAY_IMPORT |= {"run": EVERYTHING | {"cli"}, "cli": EVERYTHING | {"run"}}
BASES = ("base", "actors", "policy_base", "q_base", "soft_base")  # plumbing, and the forward that a family shares


def names(path: Path, for_types: bool = True):
    """All modules and names that a file imports, dotted; without those that only a type checker sees if so wanted."""
    tree = ast.parse(path.read_text())
    for_a_checker = [
        node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
    ]
    left_out = {id(inner) for node in for_a_checker if not for_types for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import) and id(node) not in left_out:
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and id(node) not in left_out:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imports(path: Path):
    """Folders of pgkit and third parties that a file imports."""
    for name in names(path):
        top, *rest = name.split(".")
        yield (rest[0] if rest else "pgkit") if top == "pgkit" else top


def loss_modules(path: Path):
    """Files of pgkit/losses that ``path`` imports from, for the package itself ``losses``."""
    for name in names(path):
        if name.startswith("pgkit.losses"):
            parts = name.split(".")
            yield parts[2] if len(parts) > 3 else "losses"


def outside(folder: str, path: Path):
    """Imports of ``path`` that the table forbids; errors, seams and a folder's own are free."""
    governed = {"torchrl", "gymnasium", "recipes", *MAY_IMPORT, *(file.stem for file in PGKIT.glob("[a-z]*.py"))}
    return set(imports(path)) & governed - MAY_IMPORT[folder] - FREE - {folder}


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_imports_follow_the_table(folder):
    wrong = {path.name: bad for path in (PGKIT / folder).rglob("*.py") if (bad := outside(folder, path))}
    assert not wrong, f"pgkit/{folder} may import only {sorted(MAY_IMPORT[folder])}"


def test_everybody_may_import_errors_and_seams_which_import_nobody():
    for path in (PGKIT / "errors.py", PGKIT / "seams.py"):
        assert not set(imports(path)) & set(MAY_IMPORT), path.name


def test_no_loss_imports_another_and_nobody_imports_a_recipe():
    for path in (PGKIT / "losses").glob("*.py"):
        if path.stem != "__init__":
            assert not set(loss_modules(path)) - {path.stem, *BASES}, path.name
    for path in PGKIT.rglob("*.py"):
        assert not {"recipes"} & set(imports(path)) or path.parent.name in ("cli",), path


def file_of(name: str) -> Path | None:
    """The file of pgkit that a dotted name is in: the longest beginning that is one."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:end])
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if file.exists():
                return file
    return None


def circles(files: list[Path]):
    """A sorter of the files by what they import when they run; it raises ``CycleError`` for a circle."""
    graph = {
        path: {file_of(name) for name in names(path, for_types=False) if name.startswith("pgkit.")} for path in files
    }
    return TopologicalSorter({path: {other for other in to if other} - {path} for path, to in graph.items()})


def test_no_two_files_import_each_other():
    assert len(list(circles(list(PGKIT.rglob("*.py"))).static_order())) > 100


def functions(path: Path):
    """Every function of a file."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    yield from (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kinds))


def body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its signature and docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_no_function_body_has_more_than_40_lines():
    long = {f"{path}: {f.name}": body_lines(f) for path in PGKIT.rglob("*.py") for f in functions(path)}
    assert not {name: lines for name, lines in long.items() if lines > 40}
    assert max(long.values()) > 20  # they are counted


def test_neighbours_are_seldom_asked_what_they_have():
    asked = re.compile(r"\b(?:hasattr|getattr)\(")
    assert 0 < sum(len(asked.findall(path.read_text())) for path in PGKIT.rglob("*.py")) <= 40


def test_private_torch_lives_in_two_folders():
    private = re.compile(r"\btorch\.(?:utils\.)?_(?!_)\w|\baten\._\w")
    found = {path.relative_to(PGKIT).as_posix() for path in PGKIT.rglob("*.py") if private.search(path.read_text())}
    found = {name for name in found if name.split("/")[0] not in ("compiled", "optim")}
    assert found == {"modules/ensemble.py"}  # whether vmap hides a parameter: torch has no public way to ask


def test_the_table_is_enforced(tmp_path):
    path = tmp_path / "wrong.py"
    path.write_text("from pgkit import updates\nimport gymnasium\nimport torch\nfrom pgkit.seams import Loss\n")
    assert outside("losses", path) == {"updates", "gymnasium"}
    path.write_text("from torchrl.data import Composite\nfrom pgkit.losses import A2CLoss\n")
    assert outside("updates", path) == {"torchrl", "losses"}
    path.write_text("from pgkit import losses\nfrom pgkit.losses import A2CLoss\nfrom pgkit.losses.td3 import X\n")
    assert set(loss_modules(path)) == {"losses", "td3"}


def test_the_table_has_every_folder():
    folders = {path.name for path in PGKIT.iterdir() if list(path.glob("*.py"))}
    assert folders <= set(MAY_IMPORT)
