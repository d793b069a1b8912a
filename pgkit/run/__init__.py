"""What happens around the training loop: flags, run directory, metrics, checkpoints, evaluation, curves."""

from pgkit.run.agent import Agent, load_agent
from pgkit.run.args import RunArgs, placed, setting
from pgkit.run.evaluate import evaluate, play
from pgkit.run.export import export, push_to_hub
from pgkit.run.load import load_policy
from pgkit.run.on_ray import RayArgs, collector
from pgkit.run.plots import plot
from pgkit.run.policy import Policy
from pgkit.run.run import Run
from pgkit.run.settings import launch

__all__ = [
    "Agent",
    "Policy",
    "RayArgs",
    "Run",
    "RunArgs",
    "collector",
    "evaluate",
    "export",
    "launch",
    "load_agent",
    "load_policy",
    "placed",
    "play",
    "plot",
    "push_to_hub",
    "setting",
]
