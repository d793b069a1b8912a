"""Every Python block of the README and the docs runs as written; the blocks of a page share one namespace."""

import re
import warnings
from collections.abc import Iterator
from math import isfinite
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MARK = r"(?:<!-- no-run: (?P<reason>[^\n]+?) -->\n|<!-- swap: (?P<swap>\S+) -->\n)?"
BLOCK = re.compile(MARK + r"```python\n(?P<code>.*?)^```$", re.DOTALL | re.MULTILINE)
SWAPS = ROOT / "docs" / "pages" / "swap"

# The one substitution: the README trains for a million frames, the test for two rollouts.
SHORTER = {"total_frames=1_000_000)": "total_frames=4096)"}


def blocks(page: Path) -> Iterator[tuple[int, str, str | None]]:
    """Line number and code of each block of a page that is meant to run, and the name of the swap that it is."""
    text = page.read_text(encoding="utf-8")
    for match in BLOCK.finditer(text):
        if match["reason"] is None:
            yield text.count("\n", 0, match.start("code")), match["code"], match["swap"]


def lines(code: str) -> int:
    """Lines that are neither blank nor a comment."""
    return sum(bool(line.strip()) and not line.strip().startswith("#") for line in code.splitlines())


@pytest.mark.parametrize("page", [page for page in PAGES if any(blocks(page))], ids=lambda page: page.stem)
def test_python_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for line, code, swap in blocks(page):
        for written, shorter in SHORTER.items():
            code = code.replace(written, shorter)
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            exec(compile("\n" * line + code, str(page), "exec"), namespace)
        if swap is not None:
            metrics = namespace.pop("metrics")
            assert lines(code) <= 10, f"{page}, {swap}: {lines(code)} lines"
            assert metrics["grad_norm"] > 0 and all(isfinite(value) for value in metrics.values()), (swap, metrics)


def test_every_page_is_looked_at() -> None:
    """No block escapes the pattern, and every opt-out has a reason."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert len(re.findall(r"^```python", text, re.MULTILINE)) == len(BLOCK.findall(text)), page
        assert "<!-- no-run -->" not in text, page


def test_the_table_of_swaps_counts_their_lines() -> None:
    counted = {(page.name, swap): lines(code) for page in SWAPS.glob("*.md") for _, code, swap in blocks(page) if swap}
    rows = re.findall(r"^\| .*\| \[`(\S+)`\]\((\S+?)\) \| (\d+) \|$", (SWAPS / "index.md").read_text(), re.MULTILINE)
    assert {(page, swap): int(count) for swap, page, count in rows} == counted
