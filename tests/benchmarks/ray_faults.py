"""Kills at random: actors, nodes, the learner. What is collected must be what one process collects without any.

python tests/benchmarks/ray_faults.py actors   # 20 actors, in the middle of rollouts
python tests/benchmarks/ray_faults.py nodes    # 5 nodes of a cluster of two on this machine
python tests/benchmarks/ray_faults.py learner  # 5 times the learner, which goes on with --resume-if-possible
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ray
import torch

from pgkit import collectors, envs, modules
from pgkit.collectors.cluster import connect

FAST = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500, "health_check_failure_threshold": 3}


def collector(kind: Any, workers: int) -> Any:
    torch.manual_seed(0)
    env = envs.make("CartPole-v1", num_envs=4, seed=1, workers=workers)
    return kind(env, modules.categorical_actor(env, (16,)), frames_per_batch=4 * 400, compile="off")


def with_kills(spread: Any, kills: int, kill: Callable[[], None]) -> None:
    """Collects through the kills, beside a collector in this process."""
    alone, times = collector(collectors.VectorCollector, 1), []
    timer = threading.Timer(0, lambda: None)
    while spread.deaths < kills or timer.is_alive():
        if spread.frames and spread.deaths < kills:  # the first rollout starts the actors
            timer = threading.Timer(random.uniform(0, 0.3), kill)
            timer.start()
        start = time.perf_counter()
        rollout = spread.rollout()
        times.append(time.perf_counter() - start)
        timer.join()
        assert bool((rollout == alone.rollout()).all()), "another rollout"
    print(
        f"{spread.deaths} deaths in {len(times)} rollouts, all as without; the slowest took {max(times[1:]):.1f} s, "
        f"{spread.lost} episodes lost"
    )


def actors(kills: int) -> None:
    connect(cpus=2)
    spread = collector(collectors.RayCollector, 2)

    def kill() -> None:
        places = [place for pool in spread.pools for place in pool.places()]
        os.kill(random.choice(places)[1], signal.SIGKILL)

    with_kills(spread, kills, kill)
    spread.shutdown()
    ray.shutdown()


def nodes(kills: int) -> None:
    from ray.cluster_utils import Cluster

    os.environ.setdefault("RAY_worker_niceness", "0")
    cluster = Cluster(True, head_node_args={"num_cpus": 0, "_system_config": FAST, "include_dashboard": False})
    added = [cluster.add_node(num_cpus=1), cluster.add_node(num_cpus=1)]
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
    spread = collector(collectors.RayCollector, 2)

    def kill() -> None:
        cluster.remove_node(added.pop(random.randrange(2)), allow_graceful=False)
        added.append(cluster.add_node(num_cpus=1))  # as an operator's cluster manager does

    with_kills(spread, kills, kill)
    spread.shutdown()
    ray.shutdown()
    cluster.shutdown()


def learner(kills: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        flags = "run ppo --ray --collectors 2 --env-id CartPole-v1 --compile off --eval-episodes 1 --eval-every 2048"
        run = [sys.executable, "-m", "pgkit", *flags.split(), "--total-frames", "40960", "--resume-if-possible"]
        rows = Path(folder, "run", "metrics.csv")
        for number in range(kills + 1):
            before = rows.stat().st_size if rows.exists() else 0
            process = subprocess.Popen([*run, "--run-dir", str(rows.parent)], start_new_session=True)
            while number < kills and process.poll() is None and (rows.stat().st_size if rows.exists() else 0) <= before:
                time.sleep(0.2)
            if number < kills:
                time.sleep(random.uniform(0, 3))
                process.kill()
            process.wait()
            print(f"attempt {number}: exit {process.returncode}, processes left after 10 s: {left(process.pid)}")
        print("frames:", json.loads(rows.with_name("summary.json").read_text())["frames"])


def left(session: int) -> int:
    """Processes of a session that are still there when they have had ten seconds to end."""
    for _ in range(50):
        sessions = []
        for pid in filter(str.isdigit, os.listdir("/proc")):
            try:
                sessions.append(os.getsid(int(pid)))
            except ProcessLookupError:
                continue
        if session not in sessions:
            return 0
        time.sleep(0.2)
    return sessions.count(session)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parts = {"actors": (actors, 20), "nodes": (nodes, 5), "learner": (learner, 5)}
    parser.add_argument("part", choices=list(parts))
    parser.add_argument("--kills", type=int)
    given = parser.parse_args()
    function, kills = parts[given.part]
    random.seed(0)
    shared = set(os.listdir("/dev/shm"))
    function(given.kills or kills)
    print("left in shared memory:", sorted(set(os.listdir("/dev/shm")) - shared) or "nothing")
