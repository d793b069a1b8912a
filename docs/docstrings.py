"""griffe extension: docstrings write equations as reStructuredText, mkdocstrings reads Markdown."""

import inspect
import re
from typing import Any

from griffe import Extension, Object

MATH_BLOCK = re.compile(r"^( *)\.\. math::(?: (.+\n(?:\1    .+\n)*)|\n\n?((?:\1    .*\n?|\n)+))", re.MULTILINE)
MATH = re.compile(r":math:`([^`]*)`")
REFERENCE = re.compile(r":\w+:`~?(?:[\w.]*\.)?(\w+)`")


class RestructuredText(Extension):
    """Rewrites `.. math::`, `:math:` and references such as `:class:` as Markdown."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Called for every object that griffe loads."""
        if obj.docstring:
            text = MATH_BLOCK.sub(_block, inspect.cleandoc(obj.docstring.value) + "\n")
            text = MATH.sub(r"$\1$", text)
            obj.docstring.value = REFERENCE.sub(r"`\1`", text)


def _block(match: re.Match[str]) -> str:
    indent, body = match[1], " ".join((match[2] or match[3]).split())
    if "&=" in body:  # several lines, which Sphinx aligns by itself
        body = rf"\begin{{split}} {body} \end{{split}}"
    return f"{indent}$$\n{indent}{body}\n{indent}$$\n\n"
