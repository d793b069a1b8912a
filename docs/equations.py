"""mkdocs hook: turns equations into MathML while building, so that pages need no script and no network."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Replace every arithmatex element of a page by the MathML of its LaTeX."""
    return EQUATION.sub(_mathml, content)


def _mathml(match: re.Match[str]) -> str:
    display = "inline" if match[1] == "span" else "block"
    math = convert(html.unescape(match[2]).strip(), display=display)
    return math if display == "inline" else f'<div class="equation">{math}</div>'
