"""What a swap costs: frames per second of PPO on HalfCheetah-v5 with pgkit's loss, a surrogate of one's own, TorchRL's.

    python tests/benchmarks/swap_speed.py --json swap_speed.json

The three agents differ in the loss alone. They train in alternation, each in a fresh process, and the last
lines say each one's speed as a share of the stock agent's; the goal is 85% at least.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

import contest
import tyro

ENV_ID, NUM_ENVS, STEPS, EPOCHS, MINIBATCH = "HalfCheetah-v5", 8, 256, 10, 64
SIZE = NUM_ENVS * STEPS


@dataclass
class Options(contest.Options):
    """Speed of PPO with its loss swapped."""

    frames: int = 50 * SIZE
    warmup: int = 3 * SIZE


def train(seed: int, make_loss: Callable[[Any, Any], Any], workers: int) -> Iterator[int]:
    """The agent of the README with another loss."""
    import torch

    from pgkit import advantages, collectors, envs, modules, updates

    torch.manual_seed(seed)
    env = envs.make(ENV_ID, num_envs=NUM_ENVS, seed=seed, workers=workers)
    actor, critic = modules.gaussian_actor(env, hidden=(64, 64)), modules.state_value(env, hidden=(64, 64))
    loss = make_loss(actor, critic)
    update = updates.OnPolicyUpdate(
        loss=loss,
        advantage=advantages.GAE(critic, gamma=0.99, lmbda=0.95),
        optimizer=torch.optim.Adam(loss.parameters(), lr=3e-4),
        epochs=EPOCHS,
        minibatch_size=MINIBATCH,
        max_grad_norm=0.5,
        compile="on",
    )
    collector = collectors.VectorCollector(env, actor, frames_per_batch=SIZE, total_frames=10**12)
    try:
        for rollout in collector:
            update(rollout)
            yield collector.frames
    finally:
        collector.shutdown()


def stock(actor: Any, critic: Any) -> Any:
    """pgkit's loss."""
    from pgkit import losses

    return losses.ClipPPOLoss(actor, critic, critic_coeff=0.5)


def pull_back(log_ratio: Any, advantage: Any) -> Any:
    """Simple policy optimization's surrogate (Xie et al., 2024), as in docs/pages/swap/surrogate.md."""
    ratio = log_ratio.exp()
    return ratio * advantage - advantage.abs() / (2 * 0.2) * (ratio - 1) ** 2


def surrogate(actor: Any, critic: Any) -> Any:
    """pgkit's loss with a function of one's own."""
    from pgkit import losses

    return losses.ClipPPOLoss(actor, critic, critic_coeff=0.5, surrogate=pull_back)


def torchrls(actor: Any, critic: Any) -> Any:
    """TorchRL's loss, unmodified, with the same settings."""
    from torchrl.objectives import ClipPPOLoss

    settings = {"entropy_coeff": 0.0, "normalize_advantage": True, "loss_critic_type": "l2"}
    return ClipPPOLoss(actor, critic, critic_coeff=0.5, **settings)


CONTENDERS = {
    "stock": contest.Contender(partial(train, make_loss=stock, workers=2), "pgkit", "pgkit's ClipPPOLoss"),
    "surrogate": contest.Contender(partial(train, make_loss=surrogate, workers=2), "pgkit", "surrogate=pull_back"),
    "torchrl": contest.Contender(partial(train, make_loss=torchrls, workers=2), "torchrl", "TorchRL's ClipPPOLoss"),
}

if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    result = contest.run("PPO with its loss swapped, HalfCheetah-v5, 8 envs x 256", options, CONTENDERS, "stock")
    speeds = {name: median(row["fps"] for row in rows) for name, rows in result["rounds"].items()}
    for name, speed in speeds.items():
        if "stock" in speeds:
            print(f"{name}: {100 * speed / speeds['stock']:.0f}% of the stock agent's speed")
    contest.write(options.json, result)
