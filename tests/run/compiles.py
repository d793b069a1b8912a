"""A recipe whose only compiled part is its policy, and which trains nothing."""

from dataclasses import dataclass
from typing import Any

from pgkit import collectors, modules, run


@dataclass
class Args(run.RunArgs):
    """No settings of its own."""


class Counter:
    """Stands for an update."""

    def __init__(self) -> None:
        self.frames = 0

    def state_dict(self) -> dict[str, Any]:
        return {"frames": self.frames}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.frames = state["frames"]


def main(args: Args) -> None:
    with run.Run(args, recipe="compiles") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        actor = modules.gaussian_actor(env, hidden=(8,))
        collector = collectors.VectorCollector(env, actor, frames_per_batch=2 * args.num_envs, compile="on")
        update = Counter()
        log.track(policy=actor, eval_env=args.make_env, update=update, collector=collector)
        while update.frames < args.total_frames:
            rollout = collector.rollout()
            update.frames += rollout.numel()
            log.step(update.frames, rollout)
