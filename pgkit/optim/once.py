"""Numbers that a compiled graph computes once."""

import torch
from torch import Tensor
from torch.compiler import is_compiling


def computed_once(x: Tensor) -> Tensor:
    """``x`` without gradients, a few numbers that much larger operations read.

    Compiled for a CPU, it is kept in memory: inductor's loops over the larger operations would compute it anew for
    every vector, and two powers cost more than the rest of Adam.
    """
    return torch.ops._inductor_test.realize(x) if is_compiling() and x.device.type == "cpu" else x
