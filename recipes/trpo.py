"""Trust-region policy optimization, and the natural policy gradient, for continuous and discrete actions.

The defaults are the MuJoCo settings; tuned values for other environments are in ``PRESETS`` below.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torchrl.envs import EnvBase

from pgkit import advantages, collectors, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of TRPO."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together."""
    eval_every: int = 100_000
    """Evaluate and save a checkpoint every so many frames; 0 = only at the end."""
    steps: int = run.setting(256, low=1)
    """Steps each env takes for one rollout."""
    max_kl: float = run.setting(0.01, low=0)
    """Bound of the mean KL divergence of a step."""
    natural_gradient: bool = False
    """Take the full step without a line search: the natural policy gradient."""
    cg_steps: int = run.setting(10, low=1)
    """Steps of conjugate gradients toward the natural gradient."""
    damping: float = run.setting(0.1, low=0)
    """Added to the diagonal of the Fisher matrix."""
    backtracks: int = run.setting(10, low=0)
    """Shorter steps that the line search tries, each 0.8 times the one before."""
    critic_epochs: int = run.setting(10, low=1)
    """Passes of the critic over a rollout."""
    minibatch_size: int = run.setting(64, low=1)
    """Rows of a minibatch of the critic."""
    learning_rate: float = run.setting(1e-3, low=0)
    """Adam's step size, for the critic."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    lmbda: float = run.setting(0.95, low=0, high=1)
    """GAE's lambda."""
    entropy_coeff: float = 0.0
    """Weight of the entropy bonus."""
    normalize_obs: bool = True
    """Normalize observations by their running mean and deviation."""
    scale_returns: bool = True
    """Let the critic learn returns divided by their running deviation; rewards stay as they are."""
    hidden: tuple[int, ...] = run.setting((64, 64), low=1, high=2**16)
    """Sizes of the hidden layers, of actor and critic alike."""
    log_std: float = -0.5
    """Initial log standard deviation of a continuous policy."""
    collector: Literal["pgkit", "torchrl"] = "pgkit"
    """pgkit's VectorCollector, or TorchRL's Collector: one process, and new episodes on a resume."""


PRESETS = {
    "CartPole-*": dict(
        total_frames=100_000, eval_every=25_000, steps=128, max_kl=0.02, gamma=0.98, lmbda=0.9,
        normalize_obs=False,
    ),
    "HalfCheetah-*": dict(lmbda=0.9),
    "dm_control/*": dict(),
    "dmc:*": dict(),
}  # fmt: skip

SEARCH = {
    "max_kl": (0.003, 0.05, "log"),
    "learning_rate": (3e-4, 3e-3, "log"),
    "critic_epochs": (5, 30),
    "steps": [128, 256, 512],
    "lmbda": (0.85, 0.99),
    "gamma": [0.98, 0.99, 0.995],
    "log_std": (-2.0, 0.0),
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, loss and advantage."""
    normalizer = modules.ObsNormalizer(env) if args.normalize_obs else None
    scale = modules.ReturnScale() if args.scale_returns else None

    if env.action_spec.dtype.is_floating_point:
        actor = modules.gaussian_actor(env, args.hidden, log_std=args.log_std, normalizer=normalizer)
    else:
        actor = modules.categorical_actor(env, args.hidden, normalizer=normalizer)
    critic = modules.state_value(env, args.hidden, normalizer=normalizer)

    loss = losses.TRPOLoss(actor, critic, entropy_coeff=args.entropy_coeff)
    advantage = advantages.GAE(
        critic,
        gamma=args.gamma,
        lmbda=args.lmbda,
        average_gae=True,
        return_scale=scale,
    )
    return run.Agent(actor, loss, critic, advantage, normalizer=normalizer, scale=scale)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="trpo") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        update = updates.TrustRegionUpdate(
            loss=built.loss,
            advantage=built.advantage,
            optimizer=torch.optim.Adam(built.critic.parameters(), lr=args.learning_rate),
            max_kl=args.max_kl,
            line_search=not args.natural_gradient,
            cg_steps=args.cg_steps,
            damping=args.damping,
            backtracks=args.backtracks,
            epochs=args.critic_epochs,
            minibatch_size=args.minibatch_size,
            total_frames=args.total_frames,
            compile=args.compile,
        )
        sizes = {"frames_per_batch": args.num_envs * args.steps, "total_frames": args.total_frames}
        if args.collector == "pgkit":
            collector = collectors.VectorCollector(env, built.actor, **sizes, compile=args.compile)
        else:
            collector = collectors.TorchRLCollector(env, built.actor, **sizes)

        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector)
        for rollout in collector:
            metrics = update(rollout)
            if built.normalizer is not None:
                built.normalizer.update(rollout["observation"])
            if built.scale is not None:
                built.scale.update(rollout["value_target"])
            log.step(collector.frames, rollout, metrics)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
