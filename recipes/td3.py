"""Twin delayed DDPG: twin critics, smoothed targets and a delayed actor, for continuous actions.

The defaults are the MuJoCo settings; tuned values for other environments are in ``PRESETS`` below.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torchrl.data import LazyTensorStorage
from torchrl.envs import EnvBase

from pgkit import collectors, data, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of TD3."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together; with action_repeat, decisions."""
    num_envs: int = 1
    """Envs stepped side by side."""
    threads: int = 0
    """Threads that PyTorch uses in this process; 0: 1 or 2, whichever a measurement at the start finds faster."""
    steps: int = run.setting(16, low=1)
    """Steps each env takes before as many updates; 1 is the papers' schedule."""
    overlap: bool = False
    """Collect the next rollout in other processes while this one updates: its weights are one update old."""
    random_frames: int = run.setting(10_000, low=0)
    """Frames with random actions at the start; updates begin after them."""
    exploration_noise: float = run.setting(0.1, low=0)
    """Standard deviation of the noise on collected actions, as a share of half the action's range."""
    policy_noise: float = run.setting(0.2, low=0)
    """Standard deviation of the noise on the targets' actions, as a share of half the action's range."""
    noise_clip: float = run.setting(0.5, low=0)
    """Bound of that noise, likewise."""
    batch_size: int = run.setting(256, low=1)
    """Rows of a batch."""
    updates_per_step: float = run.setting(1.0, low=0)
    """Gradient steps for each frame."""
    actor_delay: int = run.setting(2, low=1)
    """The actor learns, and the targets move, at every so many-th gradient step."""
    learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the actor."""
    q_learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the critics."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.005, low=0, high=1)
    """Share of the trained networks that their targets take over when they move."""
    buffer_size: int = run.setting(1_000_000, low=1)
    """Frames that the replay buffer keeps."""
    buffer_dir: Path | None = run.setting(None, on_resume=True)
    """Keep the replay buffer in files of this folder (a buffer beyond RAM); None keeps it in memory."""
    n_step: int = run.setting(1, low=1)
    """Length of the returns that the critics learn."""
    replay: Literal["uniform", "prioritized"] = "uniform"
    """Draw frames uniformly, or in proportion to the critics' errors."""
    save_buffer: bool = run.setting(False, on_resume=True)
    """Save the replay buffer beside each checkpoint, so that a resumed run goes on bit for bit."""
    hidden: tuple[int, ...] = run.setting((256, 256), low=1, high=2**16)
    """Sizes of the hidden layers, of actor and critics alike."""
    log_every: int = run.setting(1_000, low=1, on_resume=True)
    """A row of metrics every so many frames."""


PRESETS = {
    "Pendulum-*": dict(
        total_frames=20_000, eval_every=5_000, random_frames=1_000, learning_rate=1e-3, q_learning_rate=1e-3
    ),
    "dm_control/*": dict(total_frames=500_000, action_repeat=2),
    "dmc:*": dict(total_frames=500_000, action_repeat=2),
}

SEARCH = {
    "learning_rate": (1e-4, 3e-3, "log"),
    "q_learning_rate": (1e-4, 3e-3, "log"),
    "batch_size": [128, 256, 512],
    "exploration_noise": (0.05, 0.3),
    "policy_noise": (0.1, 0.4),
    "tau": (0.002, 0.05, "log"),
    "gamma": [0.98, 0.99, 0.995],
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, loss and exploration."""
    actor = modules.deterministic_actor(env, args.hidden)
    critics = modules.q_value(env, num_critics=2, hidden=args.hidden)
    explorer = modules.GaussianExploration(actor, env, args.exploration_noise)
    loss = losses.TD3Loss(
        actor,
        critics,
        action_spec=env.action_spec_unbatched,
        policy_noise=args.policy_noise * explorer.bounds.half_range,
        noise_clip=args.noise_clip * explorer.bounds.half_range,
        gamma=args.gamma,
    )
    return run.Agent(actor, loss, critics, explorer=explorer)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="td3") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        buffer = data.ReplayBuffer(
            env,
            args.buffer_size,
            n_steps=args.n_step,
            sampler=data.Prioritized() if args.replay == "prioritized" else None,
            storage=data.in_files(args.buffer_dir) if args.buffer_dir else LazyTensorStorage,
        )
        groups = [
            {"params": list(built.actor.parameters()), "lr": args.learning_rate},
            {"params": list(built.critic.parameters()), "lr": args.q_learning_rate},
        ]
        update = updates.OffPolicyUpdate(
            loss=built.loss,
            buffer=buffer,
            optimizer=torch.optim.Adam(groups),
            batch_size=args.batch_size,
            updates_per_step=args.updates_per_step,
            actor_delay=args.actor_delay,
            delay_targets=True,
            tau=args.tau,
            learning_starts=max(args.random_frames, args.batch_size),
            total_frames=args.total_frames,
            compile=args.compile,
        )
        make_collector = collectors.AsyncCollector if args.overlap else collectors.VectorCollector
        collector = make_collector(
            env,
            built.explorer,
            frames_per_batch=args.num_envs * args.steps,
            total_frames=args.total_frames,
            init_random_frames=args.random_frames,
            compile=args.compile,
        )

        replay = data.BesideCheckpoint(buffer, log.dir / "checkpoints" / "buffer.pt", save=args.save_buffer)
        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector, replay=replay)
        for rollout in collector:
            metrics = update(rollout)
            if args.overlap:
                metrics["policy_lag"] = collector.lag
            log.step(collector.frames, rollout, metrics, every=args.log_every)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
