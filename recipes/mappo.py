"""PPO for groups of agents, with a critic of all their observations (MAPPO) or of each one's own (IPPO).

A frame is one step of one environment, whatever the number of agents. ``pgkit run ippo`` is this recipe with
``--critic decentralized``. Tuned values are in ``PRESETS`` below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictSequential
from torch import nn

from pgkit import advantages, collectors, controllers, envs, losses, modules, run, updates
from pgkit.compiled import choose
from pgkit.errors import UserError


@dataclass
class Args(run.RunArgs):
    """Settings of MAPPO and IPPO."""

    env_id: str = "vmas/balance"
    """vmas/<scenario>, mpe2/<name>, or module:function of a PettingZoo parallel environment."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together; a step of all agents of an env is one."""
    eval_every: int = 100_000
    """Evaluate and save a checkpoint every so many frames; 0 = only at the end."""
    critic: Literal["centralized", "decentralized"] = "centralized"
    """The critic reads the observations of all agents of its group (MAPPO), or each agent's own (IPPO)."""
    share_parameters: bool = True
    """One set of parameters for all agents of a group, or one for each."""
    agent_ids: bool = False
    """Let the networks know each agent's number."""
    steps: int = run.setting(50, low=1)
    """Steps each env takes for one rollout."""
    epochs: int = run.setting(10, low=1)
    """Passes over a rollout."""
    minibatch_size: int = run.setting(400, low=1)
    """Frames of a minibatch, each with all its agents."""
    learning_rate: float = run.setting(5e-4, low=0)
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
    critic_coeff: float = run.setting(0.5, low=0)
    """Weight of the value loss."""
    max_grad_norm: float = run.setting(5.0, above=0)
    """Bound of the gradient's norm, over all groups' networks."""
    normalize_advantage: Literal["team", "agent", "minibatch", "off"] = "team"
    """Standardize the advantage over the rollout: all agents of a group together, or each by itself; over each
    minibatch; or not at all."""
    recompute_advantage: bool = False
    """Estimate the advantage again before each epoch, with the critic as it is then."""
    normalize_obs: bool = False
    """Normalize observations by their running mean and deviation."""
    scale_returns: bool = True
    """Let the critic learn returns divided by their running deviation; advantages are computed in the rewards' unit."""
    target_kl: float | None = run.setting(None, low=0)
    """Stop an update after the epoch whose KL divergence (the first group's) exceeds 1.5 times this."""
    hidden: tuple[int, ...] = run.setting((64, 64), low=1, high=2**16)
    """Sizes of the hidden layers, of actor and critic alike."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Activation of the hidden layers."""
    log_std: float = -0.5
    """Initial log standard deviation of a continuous policy."""
    variant: str = ""
    """Start from the settings of ippo."""


VARIANTS = {"ippo": dict(critic="decentralized")}

PRESETS = {
    "vmas/balance": dict(
        env={"n_agents": 4}, num_envs=600, steps=50, epochs=4, minibatch_size=3_000, learning_rate=1e-3,
        hidden=(128, 128), eval_episodes=20,
    ),
    "mpe2/simple_speaker_listener_v4": dict(
        total_frames=2_000_000, num_envs=128, steps=25, minibatch_size=3_200, learning_rate=7e-4, entropy_coeff=0.01,
        activation="relu", eval_episodes=50,
    ),
    "vmas/*": dict(
        num_envs=600, steps=50, epochs=4, minibatch_size=3_000, learning_rate=1e-3, hidden=(128, 128),
        eval_episodes=20,
    ),
    "mpe2/*": dict(
        num_envs=128, steps=25, minibatch_size=3_200, learning_rate=7e-4, entropy_coeff=0.01, activation="relu",
        eval_episodes=50,
    ),
}  # fmt: skip

SEARCH = {
    "learning_rate": (5e-5, 2e-3, "log"),
    "epochs": (5, 45),
    "minibatch_size": [200, 400, 800],
    "lmbda": (0.85, 0.98),
    "entropy_coeff": [0.0, 1e-3, 1e-2],
    "normalize_advantage": ["team", "agent", "minibatch"],
}


def group_agent(args: Args, env: envs.VectorEnv, group: str) -> run.Agent:
    """Networks, loss and advantage of one group."""
    normalizer = modules.ObsNormalizer(env, group=group) if args.normalize_obs else None
    scale = modules.ReturnScale() if args.scale_returns else None
    parts: dict[str, Any] = {
        "hidden": args.hidden,
        "activation": nn.Tanh if args.activation == "tanh" else nn.ReLU,
        "normalizer": normalizer,
        "group": group,
        "share_parameters": args.share_parameters,
        "agent_ids": args.agent_ids,
    }
    if env.full_action_spec[group, "action"].dtype.is_floating_point:
        actor = modules.gaussian_actor(env, log_std=args.log_std, **parts)
    else:
        actor = modules.categorical_actor(env, **parts)
    critic = modules.state_value(env, centralized=args.critic == "centralized", **parts)
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
        average_gae=args.normalize_advantage in ("team", "agent"),
        per_agent=args.normalize_advantage == "agent",
        return_scale=scale,
    )
    return run.Agent(actor, loss, critic, advantage, normalizer=normalizer, scale=scale)


def agent(args: Args, env: envs.VectorEnv) -> run.Agent:
    """The groups' agents as one: their actors act together, their losses are added up."""
    groups = [path[0] for path in env.groups]
    if not groups:
        raise UserError(f"mappo trains groups of agents, {env.env_id} has one agent and no group: pgkit run ppo")
    each = [group_agent(args, env, group) for group in groups]
    one = each[0]
    if len(each) > 1:
        keys = [(group, name) for group in groups for name in ("action", "action_log_prob")]
        one = run.Agent(
            actor=TensorDictSequential(*[x.actor for x in each], selected_out_keys=keys),
            loss=losses.Sum(*[x.loss for x in each]),
            critic=nn.ModuleList([x.critic for x in each]),
            advantage=TensorDictSequential(*[x.advantage for x in each]),
        )
    pairs = list(zip(groups, each, strict=True))
    one.normalizer = nn.ModuleDict({g: x.normalizer for g, x in pairs}) if args.normalize_obs else None
    one.scale = nn.ModuleDict({g: x.scale for g, x in pairs}) if args.scale_returns else None
    return one


def recorded(args: Args) -> Args:
    """With ``--env.compile auto``, where that is not said and the run is long enough to win the time back."""
    compile = choose(args.compile, args.total_frames / args.num_envs, least_calls=1_500)
    return replace(args, env={"compile": "off" if compile == "off" else "auto"} | args.env)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe=args.variant or "mappo") as log:
        env = recorded(args).make_env(args.num_envs, args.seed, args.workers)
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
            target_kl=args.target_kl,
            schedules={"lr": controllers.linear(args.learning_rate)} if args.anneal else None,
            total_frames=args.total_frames,
            compile=args.compile,
        )
        collector = collectors.VectorCollector(
            env,
            built.actor,
            frames_per_batch=args.num_envs * args.steps,
            total_frames=args.total_frames,
            compile=args.compile,
        )

        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector)
        for rollout in collector:
            metrics = update(rollout)
            for path in env.groups:
                mask, group = rollout.get((*path, "mask"), None), path[0]
                if built.normalizer is not None:
                    built.normalizer[group].update(rollout[group, "observation"], mask)
                if built.scale is not None:
                    built.scale[group].update(rollout[group, "value_target"], mask=mask)
            log.step(collector.frames, rollout, metrics)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS, variants=VARIANTS)
