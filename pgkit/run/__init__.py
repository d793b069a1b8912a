"""What happens around the training loop: flags, run directory, metrics, checkpoints, evaluation, curves."""

from pgkit.run.agent import Agent, load_agent
from pgkit.run.args import RunArgs, placed, setting
from pgkit.run.evaluate import evaluate, play
from pgkit.run.plots import plot
from pgkit.run.policy import Policy, load_policy
from pgkit.run.run import Run
from pgkit.run.settings import launch

__all__ = [
    "Agent",
    "Policy",
    "Run",
    "RunArgs",
    "evaluate",
    "launch",
    "load_agent",
    "load_policy",
    "placed",
    "play",
    "plot",
    "setting",
]
