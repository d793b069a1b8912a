"""Every pgkit flag and tag that the page for newcomers names is there."""

import ast
import re
from pathlib import Path

import pytest

from pgkit import run

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "pages" / "coming-from.md").read_text()
SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))


def cells(section: str) -> list[list[str]]:
    lines = [line for line in SECTIONS[section].splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[1:]]


@pytest.mark.parametrize("recipe", ["ppo", "sac"])
def test_flags_are_those_of_the_recipe(recipe):
    tree = ast.parse((ROOT / "recipes" / f"{recipe}.py").read_text())
    args = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Args")
    own = {
        node.target.id for node in args.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    known = own | set(run.RunArgs.__dataclass_fields__)
    named = re.findall(r"`--([a-z-]+)", " ".join(row[3] for row in cells(f"{recipe.upper()}: parameters")))
    assert len(named) >= 15 and {name.replace("-", "_") for name in named} <= known


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_every_row_has_all_its_columns(name):
    assert {len(row) for row in cells(f"{name}: parameters")} == {5}
    assert {len(row) for row in cells(f"{name}: tags")} == {4}


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_train_tags_are_entries_of_the_losses(name):
    tags = re.findall(r"`train/(\w+)`", " ".join(row[3] for row in cells(f"{name}: tags")))
    files = {"PPO": ("clip_ppo", "policy_base"), "SAC": ("sac", "soft_base")}[name]
    source = "".join((ROOT / "pgkit" / "losses" / f"{file}.py").read_text() for file in files)
    others = {"grad_norm", "skipped", "learning_rate"}  # the update's
    assert len(tags) >= 5 and all(tag in others or f'"{tag}"' in source for tag in tags)
