"""Two trees of pgkit beside each other: a minibatch step, an update, or a rollout, in alternation in two processes.

    git worktree add --detach ../before v0.1.0
    python tests/benchmarks/beside.py --trees ../before . --what step

Each tree runs its own copy of `step_cost.py`, `ppo_speed.py` and `sac_speed.py`. The ratio is that of two neighbouring
turns, so that a machine that is now fast and now slow moves both.
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

CALLS = {"step": 400, "sac": 20, "ppo": 1}  # in one turn


@dataclass
class Options:
    """What to compare."""

    trees: tuple[Path, ...] = (Path(),)
    """Working trees; the first is what the others are compared with."""
    what: Literal["step", "sac", "ppo"] = "step"
    """PPO's minibatch step, SAC's step with its draw, or a whole PPO iteration in one process."""
    turns: int = 30
    """Alternations."""
    worker: bool = False
    """Runs one tree's side, for the other process."""


def step() -> Callable[[int], Any]:
    """A call of PPO's compiled minibatch step."""
    import step_cost
    import torch

    from pgkit import advantages

    actor, critic = step_cost.agent()
    rollout = advantages.GAE(critic, gamma=0.99, lmbda=0.95)(step_cost.fake_rollout(actor))
    indices = torch.randperm(2048).split(step_cost.ROWS)
    make: Any = step_cost.pgkit_step
    loss, index = step_cost.pgkit_loss(*step_cost.agent()), indices[0]
    older = "index" not in make.__code__.co_varnames[: make.__code__.co_argcount]
    made = make(loss, rollout, True) if older else make(loss, rollout, index, True)
    if isinstance(made, tuple):
        return lambda turn: made[0](made[1], indices[turn % len(indices)])
    return lambda turn: made(indices[turn % len(indices)])


def sac() -> Callable[[int], Any]:
    """A call of SAC's update for one step."""
    import sac_speed

    update = sac_speed.agent(0, 20_000, None)[2]
    return lambda turn: update.train(1)


def ppo() -> Callable[[int], Any]:
    """A call of one rollout and its update."""
    import ppo_speed

    iterations = ppo_speed.pgkit(0, 1)
    return lambda turn: next(iterations)


def serve(what: str) -> None:
    """Answers each line with the milliseconds of a call."""
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(0)
    call, count = {"step": step, "sac": sac, "ppo": ppo}[what](), CALLS[what]
    for turn in range(max(count // 4, 4)):
        call(turn)
    print("ready", flush=True)
    for _ in sys.stdin:
        start = time.perf_counter()
        for turn in range(count):
            call(turn)
        print((time.perf_counter() - start) / count * 1e3, flush=True)


def start(tree: Path, what: str) -> Any:
    """The process of one tree, warmed up."""
    tree = tree.resolve()
    paths = os.pathsep.join([str(tree), str(tree / "tests/benchmarks")])
    command = [sys.executable, "-P", __file__, "--worker", "--what", what]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    process: Any = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": paths}, cwd=tree, **pipes)
    while (line := process.stdout.readline()) != "ready\n":
        if not line:
            raise SystemExit(f"{tree}: the benchmark ended")
    return process


def turn_of(process: Any) -> float:
    process.stdin.write("\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def main(options: Options) -> None:
    """Prints one line a tree."""
    processes = [start(tree, options.what) for tree in options.trees]
    turns = [[turn_of(process) for process in processes] for _ in range(options.turns)]
    for at, (tree, process) in enumerate(zip(options.trees, processes, strict=True)):
        times, ratios = sorted(row[at] for row in turns), sorted(row[0] / row[at] for row in turns)
        low, high = ratios[len(ratios) // 10], ratios[-1 - len(ratios) // 10]
        print(
            f"{tree}: {statistics.median(times):.4f} ms, least {times[0]:.4f}; as fast as the first "
            f"{statistics.median(ratios):.3f} times ({low:.3f} to {high:.3f})"
        )
        process.stdin.close()


if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    serve(options.what) if options.worker else main(options)
