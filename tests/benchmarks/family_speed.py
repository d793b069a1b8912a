"""Frames per second of pgkit's A2C, TRPO, TD3 and TQC on HalfCheetah-v5, each beside the peer that has it.

    python tests/benchmarks/family_speed.py --algorithm a2c

Same env, nets and updates for both sides; the settings stand in the code. `--algorithm trpo`, `td3` or `tqc` likewise;
`a2c_cartpole` is A2C on CartPole-v1. A2C runs in one process, and with two workers that collect
beside the update; TD3 has the bare matmuls of its updates as a third contender.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import contest
import floors
import torch
import tyro

ENV_ID = "HalfCheetah-v5"
RANDOM_FRAMES, CHUNK, BUFFER = 1000, 500, 1_000_000
SIZES = {
    "a2c": (100_000, 10_000),
    "a2c_cartpole": (100_000, 10_000),
    "trpo": (40_960, 6_144),
    "td3": (2_000, 2_000),
    "tqc": (2_000, 2_000),
}


@dataclass
class Options(contest.Options):
    """Speed of one algorithm of the family, two libraries in alternation."""

    frames: int = 0
    """Frames each contender trains while the clock runs; 0: as suits the algorithm."""
    warmup: int = 0
    """Frames trained before the clock starts; 0: as suits the algorithm."""
    algorithm: Literal["a2c", "a2c_cartpole", "trpo", "td3", "tqc"] = "a2c"
    """Which one."""


def on_policy(seed: int, algorithm: str, workers: int = 1) -> Iterator[int]:
    """pgkit's A2C (8 envs x 5 steps, RMSprop) or TRPO (8 envs x 256 steps, 10 critic epochs of minibatches of 128)."""
    from pgkit import advantages, collectors, envs, losses, modules, updates

    torch.manual_seed(seed)
    cartpole = algorithm == "a2c_cartpole"
    env = envs.make("CartPole-v1" if cartpole else ENV_ID, num_envs=8, seed=seed, workers=workers)
    make_actor: Any = modules.categorical_actor if cartpole else modules.gaussian_actor
    actor, critic = make_actor(env, (64, 64)), modules.state_value(env, (64, 64))
    parameters: Any = [*actor.parameters(), *critic.parameters()]
    if algorithm != "trpo":
        update: Any = updates.OnPolicyUpdate(
            loss=losses.A2CLoss(actor, critic, critic_coeff=0.5),
            advantage=advantages.GAE(critic, gamma=0.99, lmbda=1.0),
            optimizer=torch.optim.RMSprop(parameters, lr=7e-4, eps=1e-5),
            epochs=1,
            minibatch_size=None,
            max_grad_norm=0.5,
            compile="on",
        )
    else:
        update = updates.TrustRegionUpdate(
            loss=losses.TRPOLoss(actor, critic),
            advantage=advantages.GAE(critic, gamma=0.99, lmbda=0.95),
            optimizer=torch.optim.Adam(critic.parameters(), lr=1e-3),
            epochs=10,
            minibatch_size=128,
            compile="on",
        )
    make_collector = collectors.AsyncCollector if workers > 1 else collectors.VectorCollector
    collector: Any = make_collector(env, actor, frames_per_batch=8 * (256 if algorithm == "trpo" else 5))
    for rollout in collector:
        update(rollout)
        yield collector.frames


def off_policy(seed: int, algorithm: str) -> Iterator[int]:
    """pgkit's TD3 or TQC: one env, 16 frames and 16 updates in turn as in the recipes, batch 256, 2x256 ReLU."""
    from pgkit import collectors, data, envs, heads, losses, modules, updates

    torch.manual_seed(seed)
    env, sizes, settings = envs.make(ENV_ID, seed=seed), (256, 256), {}
    if algorithm == "td3":
        actor: Any = modules.deterministic_actor(env, sizes)
        loss: Any = losses.TD3Loss(actor, modules.q_value(env, 2, sizes), action_spec=env.action_spec_unbatched)
        policy: Any = modules.GaussianExploration(actor, env, 0.1)
        settings = {"actor_delay": 2, "delay_targets": True}
    else:
        actor = policy = modules.tanh_normal_actor(env, sizes)
        loss = losses.TQCLoss(actor, modules.q_value(env, 2, sizes, head=heads.Quantiles(25, 2)))
    optimizer = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], lr=3e-4)
    buffer = data.ReplayBuffer(env, BUFFER)
    update = updates.OffPolicyUpdate(
        loss, buffer, optimizer, batch_size=256, learning_starts=RANDOM_FRAMES, compile="on", **settings
    )
    collector = collectors.VectorCollector(env, policy, frames_per_batch=16, init_random_frames=RANDOM_FRAMES)
    for rollout in collector:
        update(rollout)
        yield collector.frames


def peer(seed: int, algorithm: str) -> Iterator[int]:
    """Stable-Baselines3's A2C and TD3, sb3-contrib's TRPO and TQC, with the settings above."""
    import sb3_contrib
    import stable_baselines3
    from stable_baselines3.common.env_util import make_vec_env

    replay = {"learning_rate": 3e-4, "buffer_size": BUFFER, "learning_starts": RANDOM_FRAMES, "batch_size": 256}
    replay |= {"train_freq": 1, "gradient_steps": 1}
    kinds: dict[str, tuple[Any, int, dict[str, Any]]] = {
        "a2c": (stable_baselines3.A2C, 8, {"n_steps": 5}),
        "a2c_cartpole": (stable_baselines3.A2C, 8, {"n_steps": 5}),
        "trpo": (sb3_contrib.TRPO, 8, {"n_steps": 256, "batch_size": 128, "n_critic_updates": 10}),
        "td3": (stable_baselines3.TD3, 1, {**replay, "policy_kwargs": {"net_arch": [256, 256]}}),
        "tqc": (sb3_contrib.TQC, 1, {**replay, "policy_kwargs": {"net_arch": [256, 256], "n_critics": 2}}),
    }
    kind, num_envs, settings = kinds[algorithm]
    env_id = "CartPole-v1" if algorithm == "a2c_cartpole" else ENV_ID
    model = kind("MlpPolicy", make_vec_env(env_id, num_envs, seed=seed), device="cpu", seed=seed, **settings)
    chunk = {"a2c": 4_000, "a2c_cartpole": 4_000, "trpo": 2_048}.get(algorithm, CHUNK)
    while True:
        model.learn(chunk, log_interval=10**9, reset_num_timesteps=False)
        yield model.num_timesteps


def td3_floor(seed: int) -> Iterator[int]:
    """The matmuls of TD3's updates alone, the actor's at every second one: no environment, no replay, no optimizer."""
    critics, actor = floors.actor_critic([17, 256, 256, 6], [23, 256, 256, 1], targets=2, learning=2, climbed=1)
    for frame in range(CHUNK, 10**9, CHUNK):
        for _ in range(CHUNK // 2):
            floors.run(critics + critics + actor)
        yield frame


CONTENDERS = {
    f"{name}-{side}": contest.Contender(partial(start, algorithm=name), needs, note)
    for name, ours in {
        "a2c": on_policy, "a2c_cartpole": on_policy, "trpo": on_policy, "td3": off_policy, "tqc": off_policy
    }.items()
    for side, start, needs, note in (
        ("pgkit", ours, "pgkit", "compiled, one process"),
        *([("workers", partial(on_policy, workers=2), "pgkit", "compiled, 2 workers")] if "a2c" in name else []),
        ("peer", peer, "sb3_contrib", "sb3-contrib" if name in ("trpo", "tqc") else "Stable-Baselines3"),
    )
} | {"td3-floor": contest.Contender(td3_floor, "torch", "its matmuls alone")}  # fmt: skip

if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    name = options.algorithm
    options.frames, options.warmup = options.frames or SIZES[name][0], options.warmup or SIZES[name][1]
    options.contenders = options.contenders or tuple(key for key in CONTENDERS if key.split("-")[0] == name)
    result = contest.run(name.upper(), options, CONTENDERS, f"{name}-pgkit")
    contest.write(options.json, result)
