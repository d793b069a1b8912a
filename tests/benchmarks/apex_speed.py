"""Updates per second of SAC's learner: from its own replay, from remote replay, and with explorers beside it.

``python tests/benchmarks/apex_speed.py --rounds 5 --threads 1``: HalfCheetah, 2x256, batches of 256. The three take
turns; the ratios are medians over the rounds. The explorers are limited to one frame an update, as the last case says.
"""

from __future__ import annotations

import argparse
import time
from statistics import median

import cloudpickle
import ray
import torch

from pgkit import collectors, data, updates
from pgkit.cli import recipes

FRAMES = 20_000


def learner(args, recipe, env, buffer):
    torch.manual_seed(0)
    built = recipe.agent(args, env)
    optimizer = torch.optim.Adam([*built.parameters(), *built.controller.parameters()], lr=1e-3)
    return built, updates.OffPolicyUpdate(built.loss, buffer, optimizer, batch_size=256, compile="on")


def seconds(train):
    start = time.perf_counter()
    train()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--updates", type=int, default=800)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--explorers", type=int, default=8)
    parser.add_argument("--env-id", default="HalfCheetah-v5")
    flags = parser.parse_args()
    torch.set_num_threads(flags.threads)
    recipe = recipes.load(recipes.find("apex_sac"))
    cloudpickle.register_pickle_by_value(recipe)
    args = recipe.Args(env_id=flags.env_id, explorers=flags.explorers, random_frames=0, total_frames=10**9)
    env = args.make_env(1, 1)
    collectors.connect(cpus=flags.explorers + args.shards)

    own = data.ReplayBuffer(env, 2 * FRAMES)
    filler = collectors.VectorCollector(env, recipe.agent(args, env).actor, frames_per_batch=1_000)
    replay = data.RayReplay(lambda number: recipe.shard(args, number), shards=args.shards)
    while own.written < FRAMES:
        rollout = filler.rollout()
        own.extend(rollout)
        number, shard = replay.emptiest(1_000)
        entries = {key: x.contiguous().numpy() for key, x in rollout.items(True, True)}
        call = shard.extend.remote({"entries": entries, "batch": tuple(rollout.batch_size)}, 0)
        replay.told(number, shard, 1_000, ray.get(call))

    _, plain = learner(args, recipe, env, own)
    built, remote = learner(args, recipe, env, replay)
    explorers = collectors.RayExplorers(
        lambda number, seed, frames: recipe.Explorer(args, number, seed, frames), flags.explorers, replay,
        frames_per_call=args.num_envs * args.steps, total_frames=args.total_frames, frames_per_update=1.0,
    )  # fmt: skip
    explorers.publish(built.loss.state_dict(), 0)

    def from_requests(count):
        for _ in range(count // replay.batches):
            remote.train(replay.batches)

    def explored(count):
        published = 0
        for done in range(0, count, replay.batches):
            if done - published >= 64:
                explorers.publish(built.loss.state_dict(), remote.updates)
                published = done
            explorers.collect(remote.updates)
            remote.train(replay.batches)

    cases = {"own replay": plain.train, "remote replay": from_requests, "with explorers": explored}
    for train in cases.values():  # compiles, and the explorers' processes start
        train(64)
    while explorers.frames < 20 * flags.explorers:
        explored(64)
    times = {name: [] for name in cases}
    for _ in range(flags.rounds):
        for name, train in cases.items():
            times[name].append(seconds(lambda train=train: train(flags.updates)))
            while explorers._running:
                explorers.collect(0)  # they rest while the others are timed
                time.sleep(0.01)
    for name in cases:
        ratio = median(a / b for a, b in zip(times["own replay"], times[name], strict=True))
        print(f"{name:15s} {flags.updates / median(times[name]):7.0f} updates/s   {ratio:.2f} of its own replay")
    print(f"frames {explorers.frames}, restarts {explorers.restarts}, priorities' age {replay.age:.0f} updates")


if __name__ == "__main__":
    main()
