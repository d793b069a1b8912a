"""PPO with a clipped surrogate, for continuous and discrete actions.

The defaults are the MuJoCo settings; tuned values for other environments are in ``PRESETS`` below.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torchrl.envs import EnvBase

from pgkit import advantages, collectors, controllers, losses, modules, run, updates
from pgkit.errors import UserError


@dataclass
class Args(run.RayArgs):
    """Settings of PPO."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, dm_control/<domain>-<task>-v0, or ALE/<game>-v5."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together."""
    eval_every: int = 100_000
    """Evaluate and save a checkpoint every so many frames; 0 = only at the end."""
    steps: int = run.setting(256, low=1)
    """Steps each env takes for one rollout."""
    epochs: int = run.setting(10, low=1)
    """Passes over a rollout."""
    minibatch_size: int = run.setting(64, low=1)
    """Rows of a minibatch."""
    learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size."""
    anneal: bool = run.setting(False, follows="total_frames")
    """Let the learning rate fall to zero in a straight line."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    lmbda: float = run.setting(0.95, low=0, high=1)
    """GAE's lambda."""
    clip_epsilon: float = run.setting(0.2, low=0)
    """Range of the probability ratio within which the surrogate rewards a change."""
    entropy_coeff: float = 0.0
    """Weight of the entropy bonus."""
    critic_coeff: float = run.setting(0.25, low=0)
    """Weight of the value loss."""
    max_grad_norm: float = run.setting(0.5, above=0)
    """Bound of the gradient's norm."""
    normalize_advantage: Literal["rollout", "minibatch", "off"] = "rollout"
    """Standardize the advantage over the whole rollout, over each minibatch, or not at all."""
    recompute_advantage: bool = True
    """Estimate the advantage again before each epoch, with the critic as it is then."""
    normalize_obs: bool = True
    """Normalize observations by their running mean and deviation; images are divided by 255 instead."""
    scale_returns: bool = True
    """Let the critic learn returns divided by their running deviation; rewards stay as they are."""
    target_kl: float | None = run.setting(None, low=0)
    """Stop an update after the epoch whose KL divergence exceeds 1.5 times this."""
    hidden: tuple[int, ...] = run.setting((64, 64), low=1, high=2**16)
    """Sizes of the hidden layers, of actor and critic alike; images have one encoder for both."""
    log_std: float = -0.5
    """Initial log standard deviation of a continuous policy."""
    recurrent: Literal["none", "gru", "lstm"] = "none"
    """Give actor and critic one memory, which begins anew with every episode."""
    memory_size: int = run.setting(64, low=1, high=2**16)
    """Size of the memory."""
    sequence_length: int = run.setting(16, low=1)
    """With a memory: steps of a sequence, which gradients flow through; minibatches are made of whole ones."""
    collector: Literal["pgkit", "torchrl"] = "pgkit"
    """pgkit's VectorCollector, or TorchRL's Collector: one process, and new episodes on a resume."""
    overlap: bool = False
    """Collect the next rollout in other processes while this one updates: its weights are one update old."""


PRESETS = {
    "CartPole-*": dict(
        total_frames=100_000, eval_every=25_000, steps=32, epochs=20, minibatch_size=256, learning_rate=1e-3,
        gamma=0.98, lmbda=0.8, normalize_advantage="minibatch", recompute_advantage=False,
        normalize_obs=False, scale_returns=False, critic_coeff=0.5,
    ),
    "Pendulum-*": dict(
        total_frames=200_000, eval_every=50_000, steps=128, minibatch_size=128, learning_rate=1e-3, anneal=True,
        gamma=0.95, log_std=0.5, normalize_advantage="minibatch",
    ),
    "pgkit/TMaze-*": dict(
        total_frames=50_000, eval_every=10_000, steps=128, minibatch_size=256, learning_rate=1e-3, anneal=True,
        entropy_coeff=0.01, normalize_advantage="off", normalize_obs=False, scale_returns=False, critic_coeff=0.5,
    ),
    "ALE/*": dict(
        total_frames=10_000_000, eval_every=500_000, eval_episodes=5, steps=128, epochs=4, minibatch_size=256,
        learning_rate=2.5e-4, anneal=True, clip_epsilon=0.1, entropy_coeff=0.01, critic_coeff=0.5,
        normalize_advantage="minibatch", recompute_advantage=False, scale_returns=False,
    ),
    "HalfCheetah-*": dict(lmbda=0.9),
    "Hopper-*": dict(learning_rate=2e-4, anneal=True),
    "Swimmer-*": dict(gamma=0.9999),
    "dm_control/*": dict(),
    "dmc:*": dict(),
}  # fmt: skip

SEARCH = {
    "learning_rate": (1e-4, 1e-3, "log"),
    "anneal": [False, True],
    "lmbda": (0.85, 0.98),
    "gamma": [0.98, 0.99, 0.995, 0.999],
    "steps": [128, 256, 512],
    "minibatch_size": [32, 64, 128, 256],
    "epochs": (5, 20),
    "clip_epsilon": [0.1, 0.2, 0.3],
    "entropy_coeff": [0.0, 1e-3, 1e-2],
    "normalize_advantage": ["rollout", "minibatch", "off"],
    "log_std": (-2.0, 0.0),
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, loss and advantage."""
    image = modules.image_encoder(env)
    normalizer = modules.ObsNormalizer(env) if args.normalize_obs and image is None else None
    scale = modules.ReturnScale() if args.scale_returns else None

    parts = {"hidden": args.hidden, "normalizer": normalizer} if image is None else {"encoder": image}
    if args.recurrent != "none":
        core = modules.gru if args.recurrent == "gru" else modules.lstm
        parts = {"encoder": core(env, args.memory_size, **parts)}

    if env.action_spec.dtype.is_floating_point:
        actor = modules.gaussian_actor(env, log_std=args.log_std, **parts)
    else:
        actor = modules.categorical_actor(env, **parts)
    critic = modules.state_value(env, **parts)

    loss = losses.ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=args.clip_epsilon,
        entropy_coeff=args.entropy_coeff,
        critic_coeff=args.critic_coeff,
        normalize_advantage=args.normalize_advantage == "minibatch",
    )
    advantage = advantages.GAE(
        critic,
        gamma=args.gamma,
        lmbda=args.lmbda,
        average_gae=args.normalize_advantage == "rollout",
        return_scale=scale,
    )
    return run.Agent(actor, loss, critic, advantage, normalizer=normalizer, scale=scale)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="ppo") as log:
        env = args.make_env(args.num_envs, args.seed, args.processes())
        with run.placed(args):
            built = agent(args, env)
        update = updates.OnPolicyUpdate(
            loss=built.loss,
            advantage=built.advantage,
            optimizer=torch.optim.Adam(built.parameters(), lr=args.learning_rate, eps=1e-5),
            epochs=args.epochs,
            minibatch_size=args.minibatch_size,
            sequence_length=args.sequence_length if args.recurrent != "none" else None,
            max_grad_norm=args.max_grad_norm,
            recompute_advantage=args.recompute_advantage,
            target_kl=args.target_kl,
            schedules={"lr": controllers.linear(args.learning_rate)} if args.anneal else None,
            total_frames=args.total_frames,
            compile=args.compile,
        )
        if args.learners > 1:
            collectors.connect(args.ray_address, args.processes() + args.learners)
            update = updates.RayLearners(update, args.learners, timeout=args.ray_wait)
        frames = args.num_envs * args.steps
        if args.collector == "pgkit":
            collector = run.collector(args, env, built.actor, frames_per_batch=frames, overlap=args.overlap)
        elif args.overlap or args.ray:
            given = "--overlap" if args.overlap else "--ray"
            raise UserError(f"{given}: TorchRL's Collector waits for the update, here; leave --collector at pgkit")
        else:
            collector = collectors.TorchRLCollector(
                env, built.actor, frames_per_batch=frames, total_frames=args.total_frames
            )

        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector)
        for rollout in collector:
            metrics = update(rollout)
            if args.overlap:
                metrics["policy_lag"] = collector.lag
            if built.normalizer is not None:
                built.normalizer.update(rollout["observation"])
            if built.scale is not None:
                built.scale.update(rollout["value_target"])
            log.step(collector.frames, rollout, metrics)
    collector.shutdown()
    if isinstance(update, updates.RayLearners):
        update.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
