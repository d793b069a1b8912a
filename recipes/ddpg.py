"""Deep deterministic policy gradient: one critic and a deterministic actor, for continuous actions.

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
    """Settings of DDPG."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together; with action_repeat, decisions."""
    num_envs: int = 1
    """Envs stepped side by side."""
    threads: int = 0
    """Threads that PyTorch uses in this process; 0: 1 or 2, whichever a measurement at the start finds faster."""
    steps: int = run.setting(1, low=1)
    """Steps each env takes between updates."""
    overlap: bool = False
    """Collect the next rollout in other processes while this one updates: its weights are one update old."""
    random_frames: int = run.setting(10_000, low=0)
    """Frames with random actions at the start; updates begin after them."""
    exploration_noise: float = run.setting(0.1, low=0)
    """Standard deviation of the noise on collected actions, as a share of half the action's range."""
    noise: Literal["gaussian", "ou"] = "gaussian"
    """Independent noise, or Ornstein-Uhlenbeck's, correlated in time (the paper's; exploration_noise 0.2 there)."""
    batch_size: int = run.setting(256, low=1)
    """Rows of a batch."""
    updates_per_step: float = run.setting(1.0, low=0)
    """Gradient steps for each frame."""
    learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the actor."""
    q_learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the critic."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.005, low=0, high=1)
    """Share of the trained networks that their targets take over at each gradient step."""
    buffer_size: int = run.setting(1_000_000, low=1)
    """Frames that the replay buffer keeps."""
    buffer_dir: Path | None = run.setting(None, on_resume=True)
    """Keep the replay buffer in files of this folder (a buffer beyond RAM); None keeps it in memory."""
    n_step: int = run.setting(1, low=1)
    """Length of the returns that the critic learns."""
    replay: Literal["uniform", "prioritized"] = "uniform"
    """Draw frames uniformly, or in proportion to the critic's error."""
    save_buffer: bool = run.setting(False, on_resume=True)
    """Save the replay buffer beside each checkpoint, so that a resumed run goes on bit for bit."""
    hidden: tuple[int, ...] = run.setting((256, 256), low=1, high=2**16)
    """Sizes of the hidden layers, of actor and critic alike."""
    log_every: int = run.setting(1_000, low=1, on_resume=True)
    """A row of metrics every so many frames."""


PRESETS = {
    "Pendulum-*": dict(
        total_frames=30_000, eval_every=5_000, random_frames=1_000, learning_rate=1e-3, q_learning_rate=1e-3
    ),
    "dm_control/*": dict(total_frames=500_000, action_repeat=2),
    "dmc:*": dict(total_frames=500_000, action_repeat=2),
}

SEARCH = {
    "learning_rate": (1e-4, 3e-3, "log"),
    "q_learning_rate": (1e-4, 3e-3, "log"),
    "batch_size": [128, 256, 512],
    "exploration_noise": (0.05, 0.3),
    "noise": ["gaussian", "ou"],
    "tau": (0.002, 0.05, "log"),
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, loss and exploration."""
    actor = modules.deterministic_actor(env, args.hidden)
    critic = modules.q_value(env, num_critics=1, hidden=args.hidden)
    explore = modules.GaussianExploration if args.noise == "gaussian" else modules.OrnsteinUhlenbeck
    loss = losses.DDPGLoss(actor, critic, gamma=args.gamma)
    return run.Agent(actor, loss, critic, explorer=explore(actor, env, args.exploration_noise))


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="ddpg") as log:
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
