"""What happens around the training loop: flags, run directory, metrics, checkpoints, evaluation, curves."""

from pgkit.run.evaluate import evaluate, play
from pgkit.run.plots import plot
from pgkit.run.policy import Policy, load_policy
from pgkit.run.run import Run
from pgkit.run.settings import RunArgs, launch

__all__ = ["Policy", "Run", "RunArgs", "evaluate", "launch", "load_policy", "play", "plot"]
