"""Frames per second of SAC on HalfCheetah-v5, one update a frame, beside the update's matmuls alone.

    python tests/benchmarks/sac_speed.py --json sac_speed.json

Same env, nets and update for everyone: one env, batch 256, 2x256 ReLU, twin critics, automatic temperature,
Adam 3e-4, tau 0.005, gamma 0.99, replay of a million, 1,000 random frames first.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import contest
import torch
import tyro

ENV_ID, BATCH, WIDTH, OBSERVATION, ACTION = "HalfCheetah-v5", 256, 256, 17, 6
RANDOM_FRAMES, CHUNK, BUFFER = 1000, 500, 1_000_000


@dataclass
class Options(contest.Options):
    """Speed of SAC, several libraries in alternation."""

    frames: int = 5000
    warmup: int = RANDOM_FRAMES + 1000


def pgkit(seed: int) -> Iterator[int]:
    """pgkit through its public API, one frame and one update in turn."""
    from pgkit import collectors, data, envs, losses, modules, updates

    torch.manual_seed(seed)
    env = envs.make(ENV_ID, seed=seed)
    actor, critics = modules.tanh_normal_actor(env, (WIDTH, WIDTH)), modules.q_value(env, 2, (WIDTH, WIDTH))
    loss = losses.SACLoss(actor, critics, gamma=0.99)
    update = updates.OffPolicyUpdate(
        loss,
        data.ReplayBuffer(env, BUFFER),
        torch.optim.Adam(loss.parameters(), lr=3e-4),
        batch_size=BATCH,
        learning_starts=RANDOM_FRAMES,
        tau=0.005,
        compile="on",
    )
    collector = collectors.VectorCollector(env, actor, frames_per_batch=1, init_random_frames=RANDOM_FRAMES)
    for rollout in collector:
        update(rollout)
        if collector.frames % CHUNK == 0:
            yield collector.frames


def sb3(seed: int) -> Iterator[int]:
    """Stable-Baselines3."""
    from stable_baselines3 import SAC

    yield from _baselines(SAC, seed)


def sbx(seed: int) -> Iterator[int]:
    """SBX: Stable-Baselines3's algorithms in JAX, compiled by XLA."""
    from sbx import SAC

    yield from _baselines(SAC, seed)


def torchrl(seed: int, compiled: bool) -> Iterator[int]:
    """An agent assembled from TorchRL's parts."""
    import torchrl_parts

    sizes = {"batch_size": BATCH, "random_frames": RANDOM_FRAMES, "chunk": CHUNK, "buffer": BUFFER}
    yield from torchrl_parts.sac(seed, env_id=ENV_ID, compiled=compiled, **sizes)


def _baselines(algorithm: Any, seed: int) -> Iterator[int]:
    from stable_baselines3.common.env_util import make_vec_env

    model = algorithm(
        "MlpPolicy",
        make_vec_env(ENV_ID, 1, seed=seed),
        batch_size=BATCH,
        buffer_size=BUFFER,
        learning_rate=3e-4,
        learning_starts=RANDOM_FRAMES,
        train_freq=1,
        gradient_steps=1,
        tau=0.005,
        gamma=0.99,
        ent_coef="auto",
        policy_kwargs={"net_arch": [WIDTH, WIDTH]},
        device="cpu",
        seed=seed,
    )
    while True:
        model.learn(CHUNK, log_interval=10**9, reset_num_timesteps=False)
        yield model.num_timesteps


def matmuls() -> list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Every matmul of one SAC update as (left, right, out), laid out as autograd lays them out.

    Target: actor and two critics forward. Critic loss: two critics forward; weight gradients of every layer,
    input gradients of all but the first. Actor loss: actor and two critics forward; input gradients through
    both critics down to the action; the actor's weight gradients, input gradients of all but its first layer.
    """
    actor = [OBSERVATION, WIDTH, WIDTH, 2 * ACTION]
    critic = [OBSERVATION + ACTION, WIDTH, WIDTH, 1]
    target = _forward(actor) + 2 * _forward(critic)
    critics = 2 * (_forward(critic) + _weight_gradients(critic) + _input_gradients(critic, first=1))
    through = 2 * (_forward(critic) + _input_gradients(critic, first=0))
    policy = _forward(actor) + through + _weight_gradients(actor) + _input_gradients(actor, first=1)
    return target + critics + policy


def _forward(sizes: list[int]) -> list[Any]:
    return [(torch.randn(BATCH, i), torch.randn(o, i).T, torch.empty(BATCH, o)) for i, o in pairwise(sizes)]


def _weight_gradients(sizes: list[int]) -> list[Any]:
    return [(torch.randn(BATCH, o).T, torch.randn(BATCH, i), torch.empty(o, i)) for i, o in pairwise(sizes)]


def _input_gradients(sizes: list[int], first: int) -> list[Any]:
    layers = list(pairwise(sizes))[first:]
    return [(torch.randn(BATCH, o), torch.randn(o, i), torch.empty(BATCH, i)) for i, o in layers]


def floor(threads: int) -> tuple[float, float]:
    """Milliseconds that the matmuls of one SAC update take and their GFLOP, with nothing else around them."""
    torch.set_num_threads(threads)
    calls = matmuls()
    gflop = sum(2 * left.shape[0] * left.shape[1] * right.shape[1] for left, right, _ in calls) / 1e9

    def update() -> None:
        for left, right, out in calls:
            torch.mm(left, right, out=out)

    return contest.milliseconds(update, calls=300, warmup=50), gflop


CONTENDERS = {
    "pgkit": contest.Contender(pgkit, "pgkit", "one frame, one update"),
    "sb3": contest.Contender(sb3, "stable_baselines3", "train_freq=1, gradient_steps=1"),
    "sbx": contest.Contender(sbx, "sbx", "train_freq=1, gradient_steps=1, JAX"),
    "torchrl": contest.Contender(
        partial(torchrl, compiled=False), "torchrl", f"{CHUNK} frames, {CHUNK} updates; eager"
    ),
    "torchrl-compiled": contest.Contender(
        partial(torchrl, compiled=True), "torchrl", f"{CHUNK} frames, {CHUNK} updates; torch.compile(update)"
    ),
}

if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    floors = {} if options.contender else {"before": floor(threads=2)[0]}
    result = contest.run("SAC, HalfCheetah-v5, one update a frame", options, CONTENDERS, "pgkit")
    floors["after"], gflop = floor(threads=2)
    times, most = " to ".join(f"{ms:.2f}" for ms in sorted(floors.values())), 1e3 / min(floors.values())
    print(
        f"\nfloor, 2 threads: the {len(matmuls())} matmuls of one update ({gflop:.2f} GFLOP) take {times} ms",
        end=" ",
    )
    print(f"(before and after the rounds): at most {most:.0f} updates/s")
    contest.write(options.json, {**result, "floor_ms": floors, "gflop": gflop})
