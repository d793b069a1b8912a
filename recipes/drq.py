"""DrQ: soft actor-critic from pixels, with randomly shifted images and targets and values averaged over copies.

The defaults fit two cores; the paper's batches have 512 rows, with an update at every step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torchrl.envs import EnvBase

from pgkit import collectors, controllers, data, envs, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of DrQ."""

    env_id: str = "dm_control/cartpole-swingup-v0"
    """dm_control/<domain>-<task>-v0, or a Gymnasium id with continuous actions."""
    pixels: int = run.setting(84, low=0)
    """Draw the environment with so many pixels a side; 0: its observations are images already."""
    frame_stack: int = run.setting(3, low=1)
    """Images that one observation has."""
    fast_render: bool = False
    """Draw without shadows and reflections: several times faster, another picture."""
    action_repeat: int = run.setting(4, low=1, high=10_000)
    """Simulator steps for each action."""
    total_frames: int = 25_000
    """Decisions to train for, all envs together: simulator steps are action_repeat times as many."""
    eval_every: int = 5_000
    """Evaluate and save a checkpoint every so many frames; 0 = only at the end."""
    num_envs: int = 1
    """Envs stepped side by side."""
    steps: int = run.setting(16, low=1)
    """Steps each env takes before as many updates; 1 is the paper's schedule."""
    random_frames: int = run.setting(1_000, low=0)
    """Frames with random actions before updates begin; a run no longer than that has a batch of them."""
    batch_size: int = run.setting(128, low=1)
    """Rows of a batch."""
    copies: int = run.setting(2, low=1)
    """Shifted copies of each batch: the paper's K targets and M values, which are averaged."""
    pad: int = run.setting(4, low=0)
    """Furthest shift of an image, in pixels."""
    updates_per_step: float = run.setting(0.5, low=0)
    """Gradient steps for each frame."""
    actor_delay: int = run.setting(2, low=1)
    """The actor and the temperature learn, and the targets move, at every so many-th gradient step."""
    learning_rate: float = run.setting(1e-3, low=0)
    """Adam's step size for actor, critics and temperature."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.01, low=0, high=1)
    """Share of the critics that their targets take over."""
    alpha_init: float = run.setting(0.1, low=1e-8)
    """The trained temperature at the start."""
    buffer_size: int = run.setting(100_000, low=1)
    """Frames that the replay buffer keeps; each image is stored once."""
    n_step: int = run.setting(1, low=1)
    """Length of the returns that the critics learn."""
    save_buffer: bool = run.setting(False, on_resume=True)
    """Save the replay buffer beside each checkpoint, so that a resumed run goes on bit for bit."""
    features: int = run.setting(50, low=1)
    """Size of what the encoder makes of an observation."""
    hidden: tuple[int, ...] = run.setting((1024, 1024), low=1, high=2**16)
    """Sizes of the hidden layers after it, of actor and critics alike."""
    log_every: int = run.setting(500, low=1, on_resume=True)
    """A row of metrics every so many frames."""

    def make_env(self, num_envs: int, seed: int, workers: int = 1) -> envs.VectorEnv:
        """The environment of these settings."""
        drawn = {"pixels": self.pixels, "fast_render": self.fast_render} if self.pixels else {}
        keywords = {"frame_stack": self.frame_stack, **drawn, **self.env}
        return run.RunArgs.make_env(replace(self, env=keywords), num_envs, seed, workers)


PRESETS = {
    "dm_control/cartpole-*": dict(action_repeat=8, total_frames=12_500, eval_every=2_500),
    "dm_control/finger-*": dict(action_repeat=2, total_frames=50_000),
    "dm_control/walker-*": dict(action_repeat=2, total_frames=50_000),
}

SEARCH = {
    "learning_rate": (1e-4, 1e-3, "log"),
    "batch_size": [64, 128, 256],
    "tau": (0.005, 0.05, "log"),
    "n_step": (1, 3),
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, temperature and loss: the critics' loss alone trains the convolutions."""
    encoder = modules.conv_encoder(env, features=args.features)
    own = modules.conv_encoder(env, features=args.features, shared=encoder, detach=True)
    layers = modules.mlp(args.features, None, args.hidden, torch.nn.ReLU)
    actor = modules.tanh_normal_actor(env, encoder=torch.nn.Sequential(own, layers))
    critics = modules.q_value(env, 2, args.hidden, encoder=encoder)
    spec: Any = env.action_spec_unbatched
    unit = ((spec.space.high - spec.space.low) / 2).log().sum().item()  # of actions' densities, against [-1, 1]
    temperature = controllers.Temperature(unit - spec.shape.numel(), args.alpha_init)
    loss = losses.SACLoss(actor, critics, temperature=temperature, gamma=args.gamma, augmented=True)
    return run.Agent(actor, loss, critics, controller=temperature)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="drq") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        random_frames = args.random_frames if args.random_frames < args.total_frames else args.batch_size
        buffer = data.ReplayBuffer(env, args.buffer_size, n_steps=args.n_step)
        update = updates.OffPolicyUpdate(
            loss=built.loss,
            buffer=buffer,
            optimizer=torch.optim.Adam([*built.parameters(), *built.controller.parameters()], lr=args.learning_rate),
            batch_size=args.batch_size,
            updates_per_step=args.updates_per_step,
            actor_delay=args.actor_delay,
            delay_targets=True,
            tau=args.tau,
            learning_starts=max(random_frames, args.batch_size),
            augment=modules.random_shift(args.pad, copies=args.copies),
            total_frames=args.total_frames,
            compile=args.compile,
        )
        collector = collectors.VectorCollector(
            env,
            built.actor,
            frames_per_batch=args.num_envs * args.steps,
            total_frames=args.total_frames,
            init_random_frames=random_frames,
            compile=args.compile,
        )

        replay = data.BesideCheckpoint(buffer, log.dir / "checkpoints" / "buffer.pt", save=args.save_buffer)
        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector, replay=replay)
        for rollout in collector:
            log.step(collector.frames, rollout, update(rollout), every=args.log_every)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
