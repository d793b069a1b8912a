"""Frames per second of PPO on HalfCheetah-v5: pgkit, Stable-Baselines3, SBX, and TorchRL's own parts.

    python tests/benchmarks/ppo_speed.py --json ppo_speed.json

Same env, nets, rollout, epochs and minibatch for everyone: 8 envs x 256 steps, 10 epochs, minibatch 64,
2x64 tanh, Adam 3e-4, clip 0.2, gamma 0.99, lambda 0.95, value coefficient 0.5, gradient norm 0.5, no entropy
bonus.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import contest
import tyro

ENV_ID, NUM_ENVS, STEPS, EPOCHS, MINIBATCH = "HalfCheetah-v5", 8, 256, 10, 64
SIZE = NUM_ENVS * STEPS


@dataclass
class Options(contest.Options):
    """Speed of PPO, several libraries in alternation."""

    frames: int = 50 * SIZE
    warmup: int = 3 * SIZE


def pgkit(seed: int, workers: int, overlap: bool = False) -> Iterator[int]:
    """pgkit through its public API, as in the README."""
    import torch

    from pgkit import advantages, collectors, envs, losses, modules, updates

    torch.manual_seed(seed)
    env = envs.make(ENV_ID, num_envs=NUM_ENVS, seed=seed, workers=workers)
    actor, critic = modules.gaussian_actor(env, hidden=(64, 64)), modules.state_value(env, hidden=(64, 64))
    update = updates.OnPolicyUpdate(
        loss=losses.ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.0, critic_coeff=0.5),
        advantage=advantages.GAE(critic, gamma=0.99, lmbda=0.95),
        optimizer=torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=3e-4),
        epochs=EPOCHS,
        minibatch_size=MINIBATCH,
        max_grad_norm=0.5,
        compile="on",
    )
    make_collector = collectors.AsyncCollector if overlap else collectors.VectorCollector
    collector: Any = make_collector(env, actor, frames_per_batch=SIZE, total_frames=10**12)
    try:
        for rollout in collector:
            update(rollout)
            yield collector.frames
    finally:
        collector.shutdown()


def sb3(seed: int) -> Iterator[int]:
    """Stable-Baselines3, its defaults where they agree with the contest's settings."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from torch import nn

    yield from _baselines(PPO, make_vec_env(ENV_ID, NUM_ENVS, seed=seed), nn.Tanh, seed)


def sbx(seed: int) -> Iterator[int]:
    """SBX: Stable-Baselines3's algorithms in JAX, compiled by XLA."""
    from flax import linen
    from sbx import PPO
    from stable_baselines3.common.env_util import make_vec_env

    yield from _baselines(PPO, make_vec_env(ENV_ID, NUM_ENVS, seed=seed), linen.tanh, seed)


def torchrl(seed: int, compiled: bool) -> Iterator[int]:
    """An agent assembled from TorchRL's parts."""
    import torchrl_parts

    sizes = {"num_envs": NUM_ENVS, "steps": STEPS, "epochs": EPOCHS, "minibatch": MINIBATCH}
    yield from torchrl_parts.ppo(seed, env_id=ENV_ID, compiled=compiled, **sizes)


def _baselines(algorithm: Any, env: Any, activation: Any, seed: int) -> Iterator[int]:
    model = algorithm(
        "MlpPolicy",
        env,
        n_steps=STEPS,
        batch_size=MINIBATCH,
        n_epochs=EPOCHS,
        learning_rate=3e-4,
        clip_range=0.2,
        gamma=0.99,
        gae_lambda=0.95,
        ent_coef=0.0,
        vf_coef=0.5,
        max_grad_norm=0.5,
        policy_kwargs={"activation_fn": activation, "net_arch": [64, 64]},
        device="cpu",
        seed=seed,
    )
    while True:
        model.learn(SIZE, log_interval=None, reset_num_timesteps=False)
        yield model.num_timesteps


CONTENDERS = {
    "pgkit": contest.Contender(partial(pgkit, workers=2), "pgkit", "compiled, 2 workers"),
    "pgkit-overlap": contest.Contender(
        partial(pgkit, workers=2, overlap=True), "pgkit", "as the first, with --overlap"
    ),
    "pgkit-1-worker": contest.Contender(partial(pgkit, workers=1), "pgkit", "compiled, one process"),
    "pgkit-1-overlap": contest.Contender(partial(pgkit, workers=1, overlap=True), "pgkit", "1 worker, --overlap"),
    "sb3": contest.Contender(sb3, "stable_baselines3", "DummyVecEnv"),
    "sbx": contest.Contender(sbx, "sbx", "DummyVecEnv, JAX"),
    "torchrl": contest.Contender(partial(torchrl, compiled=False), "torchrl", "Collector, SerialEnv, eager"),
    "torchrl-compiled": contest.Contender(
        partial(torchrl, compiled=True), "torchrl", "Collector, SerialEnv, torch.compile(update)"
    ),
}

if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    contest.write(options.json, contest.run("PPO, HalfCheetah-v5, 8 envs x 256", options, CONTENDERS, "pgkit"))
