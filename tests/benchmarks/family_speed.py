"""Frames per second of pgkit's A2C, TRPO, TD3, TQC and CrossQ on HalfCheetah-v5, each beside the peers that have it.

    python tests/benchmarks/family_speed.py --algorithm a2c

Same env, nets and updates for all; the settings stand in the code. `--algorithm trpo`, `td3`, `tqc` or `crossq`
likewise; `a2c_cartpole` is A2C on CartPole-v1. A2C runs in one process, and with two workers that collect beside
the update.
The off-policy ones take 16 frames and 16 updates in turn, or (`-1`) one and one; TD3 has the bare matmuls of its
updates as one more contender.
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
    "crossq": (2_000, 2_000),
}
STEPS = 16  # frames collected before as many updates, in the recipes


@dataclass
class Options(contest.Options):
    """Speed of one algorithm of the family, several libraries in alternation."""

    frames: int = 0
    """Frames each contender trains while the clock runs; 0: as suits the algorithm."""
    warmup: int = 0
    """Frames trained before the clock starts; 0: as suits the algorithm."""
    algorithm: Literal["a2c", "a2c_cartpole", "trpo", "td3", "tqc", "crossq"] = "a2c"
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


def off_policy(seed: int, algorithm: str, steps: int = STEPS) -> Iterator[int]:
    """pgkit's TD3, TQC or CrossQ: one env, so many frames and as many updates in turn, batch 256, 2x256 ReLU."""
    from pgkit import collectors, data, envs, updates

    torch.manual_seed(seed)
    env = envs.make(ENV_ID, seed=seed)
    loss, policy, settings = learner(env, algorithm)
    optimizer = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], lr=3e-4)
    buffer = data.ReplayBuffer(env, BUFFER)
    update = updates.OffPolicyUpdate(
        loss, buffer, optimizer, batch_size=256, learning_starts=RANDOM_FRAMES, compile="on", **settings
    )
    collector = collectors.VectorCollector(env, policy, frames_per_batch=steps, init_random_frames=RANDOM_FRAMES)
    for rollout in collector:
        update(rollout)
        yield collector.frames


def learner(env: Any, algorithm: str) -> tuple[Any, Any, dict[str, Any]]:
    """The loss, the policy that collects, and the settings of the update."""
    from pgkit import heads, losses, modules

    sizes = (256, 256)
    if algorithm == "td3":
        actor: Any = modules.deterministic_actor(env, sizes)
        loss: Any = losses.TD3Loss(actor, modules.q_value(env, 2, sizes), action_spec=env.action_spec_unbatched)
        return loss, modules.GaussianExploration(actor, env, 0.1), {"actor_delay": 2, "delay_targets": True}
    if algorithm == "crossq":
        body = partial(modules.batch_renorm_mlp, hidden=sizes)
        actor = modules.tanh_normal_actor(env, sizes, encoder=modules.Encoder(env, body))
        return losses.CrossQLoss(actor, modules.q_value(env, 2, sizes, body=body)), actor, {"actor_delay": 3}
    actor = modules.tanh_normal_actor(env, sizes)
    return losses.TQCLoss(actor, modules.q_value(env, 2, sizes, head=heads.Quantiles(25, 2))), actor, {}


def baselines(seed: int, algorithm: str) -> Iterator[int]:
    """Stable-Baselines3's A2C and sb3-contrib's TRPO, with the settings above."""
    import sb3_contrib
    import stable_baselines3

    if algorithm == "trpo":
        settings = {"n_steps": 256, "batch_size": 128, "n_critic_updates": 10}
        yield from _learn(sb3_contrib.TRPO, seed, ENV_ID, 8, 2_048, **settings)
    env_id = "CartPole-v1" if algorithm == "a2c_cartpole" else ENV_ID
    yield from _learn(stable_baselines3.A2C, seed, env_id, 8, 4_000, n_steps=5)


def replaying(seed: int, algorithm: str, library: str, steps: int = STEPS) -> Iterator[int]:
    """TD3, TQC or CrossQ of Stable-Baselines3, sb3-contrib or SBX, so many frames and as many updates in turn."""
    import importlib

    kind = vars(importlib.import_module(library))[algorithm.upper().replace("CROSSQ", "CrossQ")]
    policy: dict[str, Any] = {"net_arch": [256, 256]} | ({} if algorithm == "td3" else {"n_critics": 2})
    replay = {"learning_rate": 3e-4, "buffer_size": BUFFER, "learning_starts": RANDOM_FRAMES, "batch_size": 256}
    turns = {"train_freq": steps, "gradient_steps": steps, "policy_kwargs": policy}
    yield from _learn(kind, seed, ENV_ID, 1, CHUNK, **replay, **turns)


def _learn(kind: Any, seed: int, env_id: str, num_envs: int, chunk: int, **settings: Any) -> Iterator[int]:
    from stable_baselines3.common.env_util import make_vec_env

    model = kind("MlpPolicy", make_vec_env(env_id, num_envs, seed=seed), device="cpu", seed=seed, **settings)
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
    for name in ("a2c", "a2c_cartpole", "trpo")
    for side, start, needs, note in (
        ("pgkit", on_policy, "pgkit", "compiled, one process"),
        *([("workers", partial(on_policy, workers=2), "pgkit", "compiled, 2 workers")] if "a2c" in name else []),
        ("peer", baselines, "sb3_contrib", "sb3-contrib" if name == "trpo" else "Stable-Baselines3"),
    )
}
for name in ("td3", "tqc", "crossq"):
    baseline = "stable_baselines3" if name == "td3" else "sb3_contrib"
    for suffix, steps in (("", STEPS), ("-1", 1)):
        for side, start, needs in (
            ("pgkit", off_policy, "pgkit"),
            ("peer", partial(replaying, library=baseline), baseline),
            ("sbx", partial(replaying, library="sbx"), "sbx"),
        ):
            note = f"{needs}, {steps} frames, {steps} updates"
            CONTENDERS[f"{name}-{side}{suffix}"] = contest.Contender(
                partial(start, algorithm=name, steps=steps), needs, note
            )
CONTENDERS["td3-floor"] = contest.Contender(td3_floor, "torch", "its matmuls alone")

if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    name = options.algorithm
    options.frames, options.warmup = options.frames or SIZES[name][0], options.warmup or SIZES[name][1]
    options.contenders = options.contenders or tuple(key for key in CONTENDERS if key.split("-")[0] == name)
    result = contest.run(name.upper(), options, CONTENDERS, f"{name}-pgkit")
    contest.write(options.json, result)
