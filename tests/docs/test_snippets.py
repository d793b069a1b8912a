"""Every Python block of the README and the docs runs as written; the blocks of a page share one namespace."""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(?:<!-- no-run: (?P<reason>.+?) -->\n)?```python\n(?P<code>.*?)^```$", re.DOTALL | re.MULTILINE)

# The one substitution: the README trains for a million frames, the test for two rollouts.
SHORTER = {"total_frames=1_000_000)": "total_frames=4096)"}


def blocks(page: Path) -> Iterator[tuple[int, str]]:
    """Line number and code of each block of a page that is meant to run."""
    text = page.read_text(encoding="utf-8")
    for match in BLOCK.finditer(text):
        if match["reason"] is None:
            yield text.count("\n", 0, match.start("code")), match["code"]


@pytest.mark.parametrize("page", [page for page in PAGES if any(blocks(page))], ids=lambda page: page.stem)
def test_python_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for line, code in blocks(page):
        for written, shorter in SHORTER.items():
            code = code.replace(written, shorter)
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            exec(compile("\n" * line + code, str(page), "exec"), namespace)


def test_every_page_is_looked_at() -> None:
    """No block escapes the pattern, and every opt-out has a reason."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        assert len(re.findall(r"^```python", text, re.MULTILINE)) == len(BLOCK.findall(text)), page
        assert "<!-- no-run -->" not in text, page
