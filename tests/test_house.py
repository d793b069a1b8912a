"""Who may import whom: docs/house.md as a test."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
THIRD_PARTY = {"torch", "tensordict", "torchrl", "gymnasium"}
MAY_IMPORT = {
    "functional": {"torch"},
    "heads": {"functional", "torch"},
    "modules": {"heads", "torch", "tensordict", "torchrl"},
    "advantages": {"functional", "torch", "tensordict", "torchrl"},
    "controllers": {"functional", "torch"},
    "losses": {"functional", "heads", "torch", "tensordict", "torchrl"},
    "updates": {"functional", "data", "torch", "tensordict"},
    "data": {"torch", "tensordict", "torchrl"},
    "collectors": {"envs", "torch", "tensordict", "torchrl"},
    "envs": {"gymnasium", "torch", "tensordict", "torchrl"},
    "run": {"envs", "torch", "tensordict", "torchrl"},
    "cli": {"run"},
}


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            names = [f"pgkit.{alias.name}" for alias in node.names] if module == "pgkit" else [module]
        for name in names:
            top, *rest = name.split(".")
            yield (rest[0] if rest else "pgkit") if top == "pgkit" else top


BASES = ("base", "policy_base", "actor_critic_base", "q_base", "soft_base")  # plumbing, no algorithm


def loss_modules(path: Path):
    """Files of pgkit/losses that ``path`` imports from, for the package itself ``losses``."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names] if node.module == "pgkit" else [node.module]
        else:
            continue
        yield from (name.rpartition(".")[2] for name in names if name and name.startswith("pgkit.losses"))


def outside(folder: str, path: Path):
    """Imports of ``path`` that the table forbids; pgkit's errors, compiling, constants and a folder's own are free."""
    governed = THIRD_PARTY | set(MAY_IMPORT)
    free = {folder, "errors", "seams", "compiling", "constants"}
    return {name for name in imports(path) if name in governed} - MAY_IMPORT[folder] - free


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_imports_follow_the_table(folder):
    wrong = {path.name: bad for path in (ROOT / "pgkit" / folder).rglob("*.py") if (bad := outside(folder, path))}
    assert not wrong, f"pgkit/{folder} may import only {sorted(MAY_IMPORT[folder])}"


def test_no_loss_imports_another_and_nobody_imports_a_recipe():
    for path in (ROOT / "pgkit" / "losses").glob("*.py"):
        if path.stem != "__init__":
            assert not set(loss_modules(path)) - {path.stem, *BASES}, path.name
    for path in (ROOT / "pgkit").rglob("*.py"):
        assert not {"recipes"} & set(imports(path)) or path.parent.name in ("cli",), path


def test_the_table_is_enforced(tmp_path):
    path = tmp_path / "wrong.py"
    path.write_text("from pgkit import updates\nimport gymnasium\n")
    assert outside("losses", path) == {"updates", "gymnasium"}
    path.write_text("from pgkit import losses\nfrom pgkit.losses import A2CLoss\nfrom pgkit.losses.td3 import X\n")
    assert set(loss_modules(path)) == {"losses", "td3"}


def test_the_table_has_every_folder():
    folders = {path.name for path in (ROOT / "pgkit").iterdir() if list(path.glob("*.py"))}
    assert folders == set(MAY_IMPORT)
