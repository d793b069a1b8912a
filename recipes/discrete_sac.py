"""Soft actor-critic with twin critics and automatic temperature, for discrete actions.

The defaults suit small observation vectors; tuned values for other environments are in ``PRESETS`` below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torchrl.data import LazyTensorStorage
from torchrl.envs import EnvBase

from pgkit import collectors, controllers, data, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of discrete SAC."""

    env_id: str = "CartPole-v1"
    """Gymnasium id of an environment with one discrete action, or ALE/<game>-v5."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together."""
    num_envs: int = 1
    """Envs stepped side by side."""
    threads: int = 0
    """Threads that PyTorch uses in this process; 0: 1 or 2, whichever a measurement at the start finds faster."""
    steps: int = run.setting(1, low=1)
    """Steps each env takes between updates."""
    overlap: bool = False
    """Collect the next rollout in other processes while this one updates: its weights are one update old."""
    random_frames: int = run.setting(1_000, low=0)
    """Frames with random actions at the start; updates begin after them."""
    batch_size: int = run.setting(256, low=1)
    """Rows of a batch."""
    updates_per_step: float = run.setting(1.0, low=0)
    """Gradient steps for each frame."""
    actor_delay: int = run.setting(1, low=1)
    """The actor and the temperature learn at every so many-th gradient step."""
    learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the actor."""
    q_learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the critics."""
    alpha_learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the temperature."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.005, low=0, high=1)
    """Share of the critics that their targets take over at each gradient step."""
    alpha: float | None = run.setting(None, low=0)
    """A fixed temperature; None trains it."""
    alpha_init: float = run.setting(1.0, low=1e-8)
    """The trained temperature at the start."""
    target_entropy_weight: float = 0.98
    """The temperature holds the entropy at this share of the largest one, log(actions)."""
    form: Literal["expectation", "gumbel_softmax"] = "expectation"
    """Weigh all actions by their probability, or draw one with the gradient of its Gumbel-Softmax relaxation."""
    relaxation: float = run.setting(1.0, above=0)
    """Temperature of that relaxation."""
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
    """Sizes of the hidden layers, of actor and critics alike; of images, after one encoder."""
    log_every: int = run.setting(1_000, low=1, on_resume=True)
    """A row of metrics every so many frames."""


PRESETS = {
    "CartPole-*": dict(
        total_frames=100_000, eval_every=10_000, num_envs=4, updates_per_step=0.5, hidden=(64, 64), threads=1,
        learning_rate=1e-3, q_learning_rate=1e-3, alpha_learning_rate=1e-3, target_entropy_weight=0.2, tau=0.05,
        buffer_size=100_000,
    ),
    "ALE/*": dict(
        total_frames=1_000_000, eval_every=100_000, eval_episodes=5, num_envs=4, random_frames=20_000, batch_size=64,
        updates_per_step=0.25, buffer_size=300_000, hidden=(), target_entropy_weight=0.5,
    ),
}  # fmt: skip

SEARCH = {
    "learning_rate": (1e-4, 3e-3, "log"),
    "q_learning_rate": (1e-4, 3e-3, "log"),
    "batch_size": [64, 128, 256],
    "target_entropy_weight": (0.3, 0.98),
    "tau": (0.002, 0.05, "log"),
    "updates_per_step": [0.25, 0.5, 1.0],
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, temperature and loss."""
    image = modules.image_encoder(env)  # the critics', whose loss alone trains it
    own = None
    if image is not None:
        layers = modules.mlp(image.features, None, args.hidden, torch.nn.ReLU)
        own = torch.nn.Sequential(modules.Detached(image), layers)
    actor = modules.categorical_actor(env, args.hidden, torch.nn.ReLU, encoder=own)
    critics = modules.discrete_q_value(env, num_critics=2, hidden=args.hidden, encoder=image)
    if args.alpha is not None:
        temperature = controllers.FixedTemperature(args.alpha)
    else:
        actions: Any = env.action_spec_unbatched.space
        target_entropy = args.target_entropy_weight * math.log(actions.n)
        temperature = controllers.Temperature(target_entropy, args.alpha_init)
    loss = losses.DiscreteSACLoss(
        actor,
        critics,
        temperature=temperature,
        form=args.form,
        relaxation=args.relaxation,
        gamma=args.gamma,
    )
    return run.Agent(actor, loss, critics, controller=temperature)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="discrete_sac") as log:
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
        of_critics = {id(p) for p in built.critic.parameters()}  # an encoder is theirs
        of_actor = [p for p in built.actor.parameters() if id(p) not in of_critics]
        groups = [
            {"params": of_actor, "lr": args.learning_rate},
            {"params": list(built.critic.parameters()), "lr": args.q_learning_rate},
            {"params": list(built.controller.parameters()), "lr": args.alpha_learning_rate},
        ]
        update = updates.OffPolicyUpdate(
            loss=built.loss,
            buffer=buffer,
            optimizer=torch.optim.Adam([group for group in groups if group["params"]]),
            batch_size=args.batch_size,
            updates_per_step=args.updates_per_step,
            actor_delay=args.actor_delay,
            tau=args.tau,
            learning_starts=max(args.random_frames, args.batch_size),
            total_frames=args.total_frames,
            compile=args.compile,
        )
        make_collector = collectors.AsyncCollector if args.overlap else collectors.VectorCollector
        collector = make_collector(
            env,
            built.actor,
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
