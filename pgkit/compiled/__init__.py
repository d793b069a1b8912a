"""The one door to native code: record, compile, check, notice what changed, fall back."""

from pgkit.compiled.branches import every_branch
from pgkit.compiled.constants import Constants
from pgkit.compiled.door import Compiled, Mode, check_compile, choose, compiled, has_compiler
from pgkit.compiled.products import Matmul, load_matmul_state, matmul_state, set_matmul
from pgkit.compiled.trial import undone

__all__ = [
    "Compiled",
    "Constants",
    "Matmul",
    "Mode",
    "check_compile",
    "choose",
    "compiled",
    "every_branch",
    "has_compiler",
    "load_matmul_state",
    "matmul_state",
    "set_matmul",
    "undone",
]
