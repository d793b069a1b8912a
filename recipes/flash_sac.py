"""FlashSAC: SAC with residual batch-normalized networks, distributional critics and weights of unit length.

The defaults are the paper's settings with networks half as wide and half its batch, which two CPU cores can train.
``--actor-width 128 --critic-width 256 --batch-size 512`` is the paper's size, at eight times the arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import e, log, pi
from pathlib import Path
from typing import Any

import torch
from torchrl.data import LazyTensorStorage
from torchrl.envs import EnvBase

from pgkit import collectors, controllers, data, heads, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of FlashSAC."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together; with action_repeat, decisions."""
    num_envs: int = 1
    """Envs stepped side by side."""
    threads: int = 2
    """Threads that PyTorch uses in this process."""
    steps: int = run.setting(16, low=1)
    """Steps each env takes before as many updates; 1 is the paper's schedule."""
    random_frames: int = run.setting(10_000, low=0)
    """Frames with random actions before updates begin; a run no longer than that has a batch of them."""
    batch_size: int = run.setting(256, low=2)
    """Rows of a batch."""
    updates_per_step: float = run.setting(1.0, low=0)
    """Gradient steps for each frame."""
    actor_delay: int = run.setting(2, low=1)
    """The actor and the temperature learn at every so many-th gradient step."""
    learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size at the start; it falls in half a cosine wave."""
    final_learning_rate: float = run.setting(1.5e-4, low=0, follows="total_frames")
    """Adam's step size at the end."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.01, low=0, high=1)
    """Share of the critics that their targets take over at each gradient step."""
    alpha_init: float = run.setting(0.01, low=1e-8)
    """The temperature at the start."""
    target_std: float = run.setting(0.15, above=0)
    """The temperature holds the entropy of a Gaussian with this deviation, of actions scaled to [-1, 1]."""
    largest_return: float = run.setting(5.0, above=0)
    """Rewards are divided so that discounted returns stay within this; it is the range of the critics' bins."""
    bins: int = run.setting(101, low=2)
    """Bins of the critics' distributions."""
    longest_noise: int = run.setting(16, low=1)
    """Exploration noise is kept for up to so many steps, mostly for few; 1 draws anew at each."""
    actor_width: int = run.setting(64, low=1, high=2**16)
    """Width of the actor's residual stream; a block's hidden layer is four times as wide."""
    critic_width: int = run.setting(128, low=1, high=2**16)
    """Width of the critics'."""
    blocks: int = run.setting(2, low=0)
    """Residual blocks of each network."""
    buffer_size: int = run.setting(1_000_000, low=1)
    """Frames that the replay buffer keeps."""
    buffer_dir: Path | None = run.setting(None, on_resume=True)
    """Keep the replay buffer in files of this folder (a buffer beyond RAM); None keeps it in memory."""
    save_buffer: bool = run.setting(False, on_resume=True)
    """Save the replay buffer beside each checkpoint, so that a resumed run goes on bit for bit."""
    log_every: int = run.setting(1_000, low=1, on_resume=True)
    """A row of metrics every so many frames."""


PRESETS = {
    "Pendulum-*": dict(total_frames=20_000, eval_every=5_000, random_frames=1_000),
    "dm_control/*": dict(total_frames=500_000, action_repeat=2),
    "dmc:*": dict(total_frames=500_000, action_repeat=2),
}

SEARCH = {
    "learning_rate": (1e-4, 1e-3, "log"),
    "batch_size": [128, 256, 512],
    "actor_delay": [1, 2, 3],
    "target_std": (0.05, 0.3),
    "tau": (0.003, 0.03, "log"),
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, temperature and loss."""
    encoder = modules.Encoder(env, partial(modules.flash, width=args.actor_width, blocks=args.blocks))
    actor = modules.tanh_normal_actor(env, encoder=encoder, log_std_bounds=(-10.0, 2.0))
    body = partial(modules.flash, width=args.critic_width, blocks=args.blocks)
    head = heads.Categorical(-args.largest_return, args.largest_return, args.bins)
    critics = modules.q_value(env, num_critics=2, body=body, head=head)
    modules.WeightProjection(actor, critics)

    spec: Any = env.action_spec_unbatched
    unit = ((spec.space.high - spec.space.low) / 2).log().sum().item()  # of actions' densities, against [-1, 1]
    entropy = 0.5 * spec.shape.numel() * log(2 * pi * e * args.target_std**2)
    temperature = controllers.Temperature(entropy + unit, args.alpha_init)
    loss = losses.CrossQLoss(actor, critics, temperature=temperature, gamma=args.gamma, delay_qvalue=True)
    return run.Agent(
        actor,
        loss,
        critics,
        explorer=modules.NoiseRepeat(actor, env, longest=args.longest_noise),
        scale=modules.RewardScale(args.num_envs, args.gamma, args.largest_return),
        controller=temperature,
    )


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="flash_sac") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        random_frames = args.random_frames if args.random_frames < args.total_frames else args.batch_size
        buffer = data.ReplayBuffer(
            env, args.buffer_size, storage=data.in_files(args.buffer_dir) if args.buffer_dir else LazyTensorStorage
        )
        trained = [*built.parameters(), *built.controller.parameters()]
        optimizer = torch.optim.Adam(trained, lr=args.learning_rate)
        update = updates.OffPolicyUpdate(
            loss=built.loss,
            buffer=buffer,
            optimizer=optimizer,
            batch_size=args.batch_size,
            updates_per_step=args.updates_per_step,
            actor_delay=args.actor_delay,
            tau=args.tau,
            learning_starts=max(random_frames, args.batch_size),
            augment=built.scale,
            project=modules.WeightProjection(built.actor, built.critic),
            total_frames=args.total_frames,
            compile=args.compile,
        )
        collector = collectors.VectorCollector(
            env,
            built.explorer,
            frames_per_batch=args.num_envs * args.steps,
            total_frames=args.total_frames,
            init_random_frames=random_frames,
            compile=args.compile,
        )
        rate = controllers.cosine(args.learning_rate, args.final_learning_rate)

        replay = data.BesideCheckpoint(buffer, log.dir / "checkpoints" / "buffer.pt", save=args.save_buffer)
        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector, replay=replay)
        for rollout in collector:
            built.scale.update(rollout)
            for group in optimizer.param_groups:
                group["lr"] = rate(collector.frames / args.total_frames)
            metrics = update(rollout)
            log.step(collector.frames, rollout, metrics, every=args.log_every)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
