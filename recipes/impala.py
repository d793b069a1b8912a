"""IMPALA: processes here or on Ray with stale policies, one learner, V-trace; continuous and discrete actions.

The defaults are the MuJoCo settings; tuned values for other environments are in ``PRESETS`` below.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torchrl.envs import EnvBase

from pgkit import advantages, controllers, losses, modules, run, updates


@dataclass
class Args(run.RayArgs):
    """Settings of IMPALA."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together."""
    eval_every: int = 100_000
    """Evaluate and save a checkpoint every so many frames; 0 = only at the end."""
    num_envs: int = 8
    """Envs, all workers together."""
    workers: int = 2
    """Processes that collect, each a rollout of its own envs at a time."""
    steps: int = run.setting(32, low=1)
    """Steps each env takes for one rollout, on which one gradient step is taken."""
    max_lag: int | None = None
    """Bound of a rollout's lag in updates; None is twice the workers. At the workers' number runs repeat themselves."""
    delay: int = run.setting(0, low=0)
    """Collect with the weights of so many updates ago: forced lag, to study it."""
    correction: Literal["vtrace", "none"] = "vtrace"
    """V-trace, or GAE as if the rollout were the present policy's (A3C's way)."""
    learning_rate: float = run.setting(7e-4, low=0)
    """Adam's step size."""
    anneal: bool = run.setting(True, follows="total_frames")
    """Let the learning rate fall to zero in a straight line."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    lmbda: float = run.setting(1.0, low=0, high=1)
    """Weight of the long returns; 1 is the paper's."""
    rho_thresh: float = run.setting(1.0, low=0)
    """Bound of a step's importance weight."""
    c_thresh: float = run.setting(1.0, low=0)
    """Bound of the weight that carries a later step's error back."""
    entropy_coeff: float = 0.0
    """Weight of the entropy bonus."""
    critic_coeff: float = run.setting(0.5, low=0)
    """Weight of the value loss."""
    max_grad_norm: float = run.setting(0.5, above=0)
    """Bound of the gradient's norm."""
    normalize_advantage: bool = False
    """Standardize the advantage over the rollout."""
    normalize_obs: bool = True
    """Normalize observations by their running mean and deviation."""
    scale_returns: bool = True
    """Let the critic learn returns divided by their running deviation; rewards stay as they are."""
    hidden: tuple[int, ...] = run.setting((64, 64), low=1, high=2**16)
    """Sizes of the hidden layers, of actor and critic alike."""
    log_std: float = -0.5
    """Initial log standard deviation of a continuous policy."""


PRESETS = {
    "CartPole-*": dict(
        total_frames=300_000, eval_every=50_000, steps=32, learning_rate=2e-3, lmbda=0.95, normalize_advantage=True,
        normalize_obs=False,
    ),
    "HalfCheetah-*": dict(lmbda=0.95),
    "dm_control/*": dict(),
    "dmc:*": dict(),
}  # fmt: skip

SEARCH = {
    "learning_rate": (1e-4, 3e-3, "log"),
    "steps": [16, 32, 64],
    "lmbda": (0.9, 1.0),
    "gamma": [0.98, 0.99, 0.995],
    "entropy_coeff": [0.0, 1e-3, 1e-2],
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

    loss = losses.A2CLoss(actor, critic, entropy_coeff=args.entropy_coeff, critic_coeff=args.critic_coeff)
    settings = {"gamma": args.gamma, "lmbda": args.lmbda, "return_scale": scale}
    if args.correction == "vtrace":
        thresholds = {"rho_thresh": args.rho_thresh, "c_thresh": args.c_thresh}
        advantage = advantages.VTrace(critic, actor, **settings, **thresholds, standardize=args.normalize_advantage)
    else:
        advantage = advantages.GAE(critic, **settings, average_gae=args.normalize_advantage)
    return run.Agent(actor, loss, critic, advantage, normalizer=normalizer, scale=scale)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="impala") as log:
        env = args.make_env(args.num_envs, args.seed, args.processes())
        with run.placed(args):
            built = agent(args, env)
        update = updates.OnPolicyUpdate(
            loss=built.loss,
            advantage=built.advantage,
            optimizer=torch.optim.Adam(built.parameters(), lr=args.learning_rate, eps=1e-5),
            epochs=1,
            minibatch_size=None,
            max_grad_norm=args.max_grad_norm,
            schedules={"lr": controllers.linear(args.learning_rate)} if args.anneal else None,
            total_frames=args.total_frames,
            compile=args.compile,
        )
        collector = run.collector(
            args,
            env,
            built.actor,
            frames_per_batch=args.num_envs // args.processes() * args.steps,
            asynchronous=True,
            max_lag=args.max_lag,
            delay=args.delay,
        )

        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector)
        for rollout in collector:
            metrics = update(rollout)
            metrics["policy_lag"] = collector.lag
            if built.normalizer is not None:
                built.normalizer.update(rollout["observation"])
            if built.scale is not None:
                built.scale.update(rollout["value_target"], built.critic)
            log.step(collector.frames, rollout, metrics)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
