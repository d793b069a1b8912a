"""Writes docs/pages/reliability.md from the fault tests' markers: python tests/reliability.py."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

TESTS = Path(__file__).parent
PAGE = TESTS.parent / "docs" / "pages" / "reliability.md"
PARTS = {"What an environment hands over": 12, "Files": 20, "Signals, processes, time": 26, "Command line": 32}
PARTS |= {"Numbers": 34}  # up to which kind
KINDS = {
    1: "Shapes and types at every write", 2: "Values that are not finite, or too large", 3: "Outliers",
    4: "Arrays shared with user code", 5: "Seeds", 6: "`reset` options and `info`", 7: "Stateful wrappers",
    8: "Spaces", 9: "Bounds", 10: "Actions in training and in `predict`", 11: "Modules with a mode",
    12: "Endless episodes", 13: "No code in files", 14: "Damaged files", 15: "What is evaluated",
    16: "Deleting", 17: "Links", 18: "Young runs", 19: "Two processes, one directory",
    20: "Full disks and other limits", 21: "Signals", 22: "Exceptions", 23: "Hangs", 24: "Dead workers",
    25: "Second interrupts", 26: "Two runs side by side", 27: "The import path", 28: "Wrappers, ids and plugins",
    29: "Environments inside recipes", 30: "Memory", 31: "Absurd arguments and terminals", 32: "Logs and advice",
    33: "Infinities in the maths", 34: "Rows that are not successors",
}  # fmt: skip
HEAD = """# Reliability

How pgkit reacts to faults. Each row is a test that injects the fault and checks the outcome. `pytest -k NAME` runs one;
`python tests/reliability.py` writes this page from the tests.

pgkit reacts in one of three ways. A mistake that one line can explain is a `UserError`: the command line prints that
line and exits with code 2. A training that diverged exits with code 3. All other faults are repaired, and the numbers
stay the same.
"""


class Fault(NamedTuple):
    """One row: what a test injects, and what comes of it."""

    kind: int
    injected: str
    outcome: str
    test: str


def faults() -> list[Fault]:
    """The markers ``@pytest.mark.fault(kind=, injected=, outcome=)`` of all tests, by kind; the tests are not run."""
    found = [fault for file in sorted(TESTS.rglob("test_*.py")) for fault in _of(ast.parse(file.read_text("utf-8")))]
    return sorted(found, key=lambda fault: fault.kind)


def _of(tree: ast.Module) -> Iterator[Fault]:
    for node in ast.walk(tree):
        for call in node.decorator_list if isinstance(node, ast.FunctionDef) else []:
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "pytest.mark.fault":
                yield Fault(**{x.arg or "": ast.literal_eval(x.value) for x in call.keywords}, test=node.name)


def page(found: list[Fault]) -> str:
    """The whole page."""
    lines, first = [HEAD], 1
    for part, last in PARTS.items():
        lines.append(f"## {part}\n")
        for kind in range(first, last + 1):
            rows = [fault for fault in found if fault.kind == kind]
            if rows:
                lines += [f"### {KINDS[kind]}\n", "| injected | outcome | test |", "|---|---|---|"]
                lines += [f"| {row.injected} | {row.outcome} | `{row.test}` |" for row in rows]
                lines.append("")
        first = last + 1
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(faults()), encoding="utf-8")
    print(f"wrote {PAGE}")
