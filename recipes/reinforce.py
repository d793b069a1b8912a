"""REINFORCE with or without a learned baseline, for continuous and discrete actions.

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
    """Settings of REINFORCE."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together."""
    eval_every: int = 100_000
    """Evaluate and save a checkpoint every so many frames; 0 = only at the end."""
    steps: int = run.setting(256, low=1)
    """Steps each env takes for one rollout, on which one gradient step is taken."""
    learning_rate: float = run.setting(3e-3, low=0)
    """Adam's step size."""
    anneal: bool = run.setting(True, follows="total_frames")
    """Let the learning rate fall to zero in a straight line."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    baseline: bool = True
    """Subtract a learned value from the return, which also stands for what the rollout does not show."""
    reward_to_go: bool = True
    """Weigh an action by the rewards after it; off: by those of the whole episode."""
    max_grad_norm: float = run.setting(0.5, above=0)
    """Bound of the gradient's norm."""
    normalize_advantage: bool = True
    """Standardize the advantage over the rollout."""
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
    "CartPole-*": dict(total_frames=300_000, eval_every=50_000, steps=32, learning_rate=5e-3, normalize_obs=False),
    "dm_control/*": dict(),
    "dmc:*": dict(),
}

SEARCH = {
    "learning_rate": (3e-4, 1e-2, "log"),
    "steps": [128, 256, 512],
    "gamma": [0.98, 0.99, 0.995],
    "normalize_advantage": [False, True],
    "log_std": (-2.0, 0.0),
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, loss and advantage."""
    normalizer = modules.ObsNormalizer(env) if args.normalize_obs else None
    scale = modules.ReturnScale() if args.scale_returns and args.baseline else None

    if env.action_spec.dtype.is_floating_point:
        actor = modules.gaussian_actor(env, args.hidden, log_std=args.log_std, normalizer=normalizer)
    else:
        actor = modules.categorical_actor(env, args.hidden, normalizer=normalizer)
    critic = modules.state_value(env, args.hidden, normalizer=normalizer) if args.baseline else None

    loss = losses.ReinforceLoss(actor, critic)
    advantage = advantages.MonteCarlo(
        critic,
        gamma=args.gamma,
        reward_to_go=args.reward_to_go,
        standardize=args.normalize_advantage,
        return_scale=scale,
    )
    return run.Agent(actor, loss, critic, advantage, normalizer=normalizer, scale=scale)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="reinforce") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        update = updates.OnPolicyUpdate(
            loss=built.loss,
            advantage=built.advantage,
            optimizer=torch.optim.Adam(built.parameters(), lr=args.learning_rate),
            epochs=1,
            minibatch_size=None,
            max_grad_norm=args.max_grad_norm,
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
            metrics = update(rollout)
            if built.normalizer is not None:
                built.normalizer.update(rollout["observation"])
            if built.scale is not None:
                built.scale.update(rollout["value_target"], built.critic)
            log.step(collector.frames, rollout, metrics)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
