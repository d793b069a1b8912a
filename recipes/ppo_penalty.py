"""PPO with an adaptive KL penalty, for continuous and discrete actions.

The defaults are the MuJoCo settings; tuned values for other environments are in ``PRESETS`` below.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torchrl.envs import EnvBase

from pgkit import advantages, collectors, controllers, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of PPO with a KL penalty."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
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
    kl_target: float = run.setting(0.01, low=0)
    """KL divergence of an update that the penalty's weight aims at."""
    beta: float = run.setting(1.0, low=0)
    """Weight of the penalty at the start."""
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
        total_frames=100_000, eval_every=25_000, steps=32, epochs=20, minibatch_size=256, learning_rate=1e-3,
        gamma=0.98, lmbda=0.8, kl_target=0.02, normalize_advantage="minibatch", recompute_advantage=False,
        normalize_obs=False, scale_returns=False, critic_coeff=0.5,
    ),
    "HalfCheetah-*": dict(lmbda=0.9),
    "Hopper-*": dict(learning_rate=2e-4, anneal=True),
    "dm_control/*": dict(),
    "dmc:*": dict(),
}  # fmt: skip

SEARCH = {
    "learning_rate": (1e-4, 1e-3, "log"),
    "lmbda": (0.85, 0.98),
    "gamma": [0.98, 0.99, 0.995],
    "minibatch_size": [64, 128, 256],
    "epochs": (5, 20),
    "kl_target": (0.003, 0.03, "log"),
    "log_std": (-2.0, 0.0),
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, loss with its penalty, and advantage."""
    normalizer = modules.ObsNormalizer(env) if args.normalize_obs else None
    scale = modules.ReturnScale() if args.scale_returns else None

    if env.action_spec.dtype.is_floating_point:
        actor = modules.gaussian_actor(env, args.hidden, log_std=args.log_std, normalizer=normalizer)
    else:
        actor = modules.categorical_actor(env, args.hidden, normalizer=normalizer)
    critic = modules.state_value(env, args.hidden, normalizer=normalizer)

    penalty = controllers.AdaptiveKL(args.kl_target, args.beta)
    loss = losses.KLPENPPOLoss(
        actor,
        critic,
        controller=penalty,
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
    return run.Agent(actor, loss, critic, advantage, normalizer=normalizer, scale=scale, controller=penalty)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="ppo_penalty") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        update = updates.OnPolicyUpdate(
            loss=built.loss,
            advantage=built.advantage,
            optimizer=torch.optim.Adam(built.parameters(), lr=args.learning_rate, eps=1e-5),
            epochs=args.epochs,
            minibatch_size=args.minibatch_size,
            max_grad_norm=args.max_grad_norm,
            recompute_advantage=args.recompute_advantage,
            schedules={"lr": controllers.linear(args.learning_rate)} if args.anneal else None,
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
            built.loss.keep_distribution(rollout)
            metrics = update(rollout)
            built.controller.update(built.loss.kl(rollout))
            if built.normalizer is not None:
                built.normalizer.update(rollout["observation"])
            if built.scale is not None:
                built.scale.update(rollout["value_target"])
            log.step(collector.frames, rollout, metrics)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
