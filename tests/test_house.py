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
    "run": {"torch", "tensordict", "torchrl"},
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


def outside(folder: str, path: Path):
    """Imports of ``path`` that the table forbids; pgkit.errors, pgkit.compiling and a folder's own files are free."""
    governed = THIRD_PARTY | set(MAY_IMPORT)
    return {name for name in imports(path) if name in governed} - MAY_IMPORT[folder] - {folder, "errors", "compiling"}


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_imports_follow_the_table(folder):
    wrong = {path.name: bad for path in (ROOT / "pgkit" / folder).rglob("*.py") if (bad := outside(folder, path))}
    assert not wrong, f"pgkit/{folder} may import only {sorted(MAY_IMPORT[folder])}"


def test_no_loss_imports_another_and_nobody_imports_a_recipe():
    losses = {path.stem for path in (ROOT / "pgkit" / "losses").glob("*.py")} - {"__init__", *BASES}
    for path in (ROOT / "pgkit" / "losses").glob("*.py"):
        if path.stem != "__init__":
            source = path.read_text()
            assert not [name for name in losses - {path.stem} if f"pgkit.losses.{name}" in source], path.name
    for path in (ROOT / "pgkit").rglob("*.py"):
        assert not {"recipes"} & set(imports(path)) or path.parent.name in ("cli",), path


def test_the_table_is_enforced(tmp_path):
    path = tmp_path / "wrong.py"
    path.write_text("from pgkit import updates\nimport gymnasium\n")
    assert outside("losses", path) == {"updates", "gymnasium"}
