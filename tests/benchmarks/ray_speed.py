"""Collecting on Ray beside plain workers, TorchRL's Ray collector, and RLlib: frames per second.

    python tests/benchmarks/ray_speed.py workers   # HalfCheetah, as many plain workers as Ray actors, in turn
    python tests/benchmarks/ray_speed.py slow      # an environment that sleeps 2 ms a step: --actors 1 8 16
    python tests/benchmarks/ray_speed.py torchrl   # TorchRL's collector with backend="ray", in turn with pgkit's
    python tests/benchmarks/ray_speed.py rllib     # RLlib's PPO (an environment of its own: pip install "ray[rllib]")

Each collects rollouts of 8 environments x 256 steps with a policy of two layers of 64, and says the median.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any

import gymnasium as gym
import torch

from pgkit import collectors, envs, modules
from pgkit.collectors.cluster import connect

ENVS, STEPS = 8, 256


class Sleeps(gym.Env):
    """An environment whose step takes 2 ms of somebody else's time."""

    observation_space, action_space = gym.spaces.Box(-1, 1, (17,)), gym.spaces.Box(-1, 1, (6,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        time.sleep(0.002)
        return self.observation_space.sample(), 0.0, False, False, {}


def collector(kind: Any, workers: int, env_id: Any = "HalfCheetah-v5", num_envs: int = ENVS, **sizes: int) -> Any:
    torch.manual_seed(0)
    env = envs.make(env_id, num_envs=num_envs, seed=1, workers=workers)
    frames = num_envs * sizes.get("steps", STEPS)
    return kind(env, modules.gaussian_actor(env, hidden=(64, 64)), frames_per_batch=frames, compile="off")


def speed(rollout: Callable[[], Any], frames: int) -> float:
    start = time.perf_counter()
    rollout()
    return frames / (time.perf_counter() - start)


def in_turn(named: dict[str, Callable[[], Any]], frames: int, turns: int) -> dict[str, float]:
    """The median of each, after a rollout of each that does not count."""
    for rollout in named.values():
        rollout()
    speeds: dict[str, list[float]] = {name: [] for name in named}
    for _ in range(turns):
        for name, rollout in named.items():
            speeds[name].append(speed(rollout, frames))
    return {name: median(values) for name, values in speeds.items()}


def show(speeds: dict[str, float]) -> None:
    first = next(iter(speeds.values()))
    for name, value in speeds.items():
        print(f"{name:<28} {value:>10,.0f} frames/s {value / first:>7.2f}", flush=True)


def workers(turns: int, actors: list[int]) -> None:
    for count in actors:
        plain = collector(collectors.VectorCollector, count)
        spread = collector(collectors.RayCollector, count)
        named = {f"{count} plain workers": plain.rollout, f"{count} Ray actors": spread.rollout}
        show(in_turn(named, ENVS * STEPS, turns))
        plain.shutdown()
        spread.shutdown()


def slow(turns: int, actors: list[int]) -> None:
    speeds = {}
    for count in actors:
        spread = collector(collectors.RayCollector, count, Sleeps, num_envs=count)
        name = f"{count} actors, 2 ms a step"
        speeds |= in_turn({name: spread.rollout}, count * STEPS, max(turns // 4, 2))
        spread.shutdown()
    show(speeds)  # environments are as many as actors


def torchrls(turns: int, _: list[int]) -> None:
    connect(cpus=4)
    makers = [partial(envs.make, "HalfCheetah-v5", num_envs=ENVS // 2, seed=seed) for seed in (1, 2)]
    actor = modules.gaussian_actor(makers[0](), hidden=(64, 64))
    theirs = iter(collectors.TorchRLCollector(makers, actor, frames_per_batch=ENVS * STEPS, backend="ray"))
    ours = collector(collectors.RayCollector, 2)
    show(in_turn({"TorchRL, 2 actors": partial(next, theirs), "pgkit, 2 actors": ours.rollout}, ENVS * STEPS, turns))


def rllib(turns: int, _: list[int]) -> None:
    """PPO's sampling alone: RLlib's own measure of it, at the same number of environments and the same network."""
    from ray.rllib.algorithms.ppo import PPOConfig  # pyright: ignore[reportMissingImports]
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig  # pyright: ignore

    config = (
        PPOConfig()
        .environment("HalfCheetah-v5")
        .env_runners(num_env_runners=2, num_envs_per_env_runner=ENVS // 2, rollout_fragment_length=STEPS)
        .training(train_batch_size=ENVS * STEPS, minibatch_size=64, num_epochs=10)
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64], vf_share_layers=False))
    )
    algorithm = config.build_algo()
    show(in_turn({"RLlib's PPO, 2 actors": algorithm.train}, ENVS * STEPS, max(turns // 8, 2)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parts = {"workers": workers, "slow": slow, "torchrl": torchrls, "rllib": rllib}
    parser.add_argument("part", choices=list(parts))
    parser.add_argument("--turns", type=int, default=20)
    parser.add_argument("--actors", type=int, nargs="+")
    given = parser.parse_args()
    parts[given.part](given.turns, given.actors or {"slow": [1, 8, 16]}.get(given.part, [1, 2]))
