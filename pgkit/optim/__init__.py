"""Optimizers: rules in optax's shape for the compiled graph, and the user's own ``torch.optim`` outside it."""

from pgkit.optim.bound import Bound, bound
from pgkit.optim.once import computed_once
from pgkit.optim.optimizers import Together, check_optimizer, parameters, step

__all__ = ["Bound", "Together", "bound", "check_optimizer", "computed_once", "parameters", "step"]
