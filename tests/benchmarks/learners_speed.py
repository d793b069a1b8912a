"""What a step costs with two learners: gradients, one all-reduce over gloo, the optimizer; against one process.

``python tests/benchmarks/learners_speed.py``: PPO's networks for HalfCheetah (2x64), a rollout of 8,192 rows, one epoch
in minibatches of 64 and of 4,096 rows of all learners together. One process has one thread, or two.
"""

from __future__ import annotations

import argparse
import socket
import time
from statistics import median

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from tensordict import TensorDict

from pgkit import advantages, envs, losses, modules, updates

ROWS = 8_192


def make(minibatch):
    torch.manual_seed(0)
    env = envs.make("HalfCheetah-v5", num_envs=8)
    actor, critic = modules.gaussian_actor(env), modules.state_value(env)
    loss = losses.ClipPPOLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    settings = {"epochs": 1, "minibatch_size": minibatch, "compile": "on", "seed": 0}
    return updates.OnPolicyUpdate(loss, advantages.GAE(critic), optimizer, **settings)


def make_rollout():
    def draw(*size):
        return torch.randn(8, ROWS // 8, *size)

    flags = {key: torch.zeros(8, ROWS // 8, 1, dtype=torch.bool) for key in ("done", "terminated")}
    observation = draw(17)
    following = {"observation": torch.cat([observation[:, 1:], draw(17)[:, :1]], 1), "reward": draw(1), **flags}
    data = {"observation": observation, "action": draw(6), "action_log_prob": draw() - 8, "next": following}
    return TensorDict(data, (8, ROWS // 8))


def times(update, rollout, rounds):
    update(rollout)
    taken = []
    for _ in range(rounds):
        start = time.perf_counter()
        update(rollout)
        taken.append(time.perf_counter() - start)
    return median(taken)


def learner(rank, port, rounds):
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    for minibatch in (64, 4_096):
        update = updates.data_parallel(make(minibatch))
        taken = times(update, make_rollout().chunk(2)[rank].clone(), rounds)
        flat = torch.zeros(sum(p.numel() for p in update.loss.parameters()) + 9)
        start = time.perf_counter()
        for _ in range(200):
            dist.all_reduce(flat)
        reduce = (time.perf_counter() - start) / 200
        if rank == 0:
            steps = ROWS // minibatch
            print(f"two learners, {minibatch:5d} rows: {1e3 * taken / steps:6.2f} ms a step, ", end="")
            print(f"an all-reduce of the gradients alone {1e3 * reduce:.2f} ms", flush=True)
    dist.destroy_process_group()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2], help="of the one process; none: leave it out")
    flags = parser.parse_args()
    for threads in flags.threads:
        torch.set_num_threads(threads)
        for minibatch in (64, 4_096):
            taken = times(make(minibatch), make_rollout(), flags.rounds)
            steps = ROWS // minibatch
            print(
                f"one process, {threads} threads, {minibatch:5d} rows: {1e3 * taken / steps:6.2f} ms a step", flush=True
            )
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    mp.spawn(learner, (port, flags.rounds), nprocs=2)


if __name__ == "__main__":
    main()
