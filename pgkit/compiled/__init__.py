"""The one door to native code: record, compile, check, notice what changed, fall back."""

from pgkit.compiled.branches import every_branch
from pgkit.compiled.constants import Constants, tensors_of
from pgkit.compiled.door import Compiled, Mode, check_compile, choose, compiled, has_compiler
from pgkit.compiled.native import Instead, copy_all
from pgkit.compiled.products import Matmul, chosen, load_matmul_state, matmul_state, set_matmul
from pgkit.compiled.trial import undone, written_by

__all__ = [
    "Compiled",
    "Constants",
    "Instead",
    "Matmul",
    "Mode",
    "check_compile",
    "choose",
    "chosen",
    "compiled",
    "copy_all",
    "every_branch",
    "has_compiler",
    "load_matmul_state",
    "matmul_state",
    "set_matmul",
    "tensors_of",
    "undone",
    "written_by",
]
