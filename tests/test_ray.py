"""Collecting on Ray: the numbers of one process, whatever the actors' number and whichever of them dies."""

import csv
import os
import signal
import threading
import time
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import ray
import torch

from pgkit import collectors, envs, modules
from pgkit.cli import recipes
from pgkit.collectors.cluster import Waiting, connect
from pgkit.errors import UserError
from pgkit.run.settings import parse


def rays_processes() -> set[str]:
    """Processes that Ray started for this one, and not for another of the tests' processes."""
    found, session, variable = set(), os.getsid(0), "PYTEST_XDIST_WORKER"
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/stat") as stat, open(f"/proc/{pid}/environ") as environ:
                name, rest = stat.read().rpartition(")")[::2]
                worker = dict(line.partition("=")[::2] for line in environ.read().split("\0")).get(variable)
        except OSError:
            continue
        ours = int(rest.split()[3]) == session and worker == os.environ.get(variable)
        if ours and name.partition("(")[2].startswith(("ray", "gcs_server")):
            found.add(name)
    return found


@pytest.fixture(scope="module", autouse=True)
def cluster():
    """One small cluster for all tests; its processes are gone after them."""
    before = rays_processes()
    connect(cpus=5)
    yield
    ray.shutdown()
    end = time.monotonic() + 20
    while (left := rays_processes() - before) and time.monotonic() < end:
        time.sleep(0.2)
    assert not left


def equal(a, b):
    return set(a.keys(True, True)) == set(b.keys(True, True)) and bool((a == b).all())


def make(workers, kind=collectors.RayCollector, env_id="CartPole-v1", memory=False, num_envs=4, steps=50, **kwargs):
    torch.manual_seed(0)
    env = envs.make(env_id, num_envs=num_envs, seed=3, workers=workers)
    parts = {"encoder": modules.gru(env, 8)} if memory else {"normalizer": modules.ObsNormalizer(env)}
    build = modules.gaussian_actor if env.action_spec.dtype.is_floating_point else modules.categorical_actor
    actor = build(env, **parts)
    return actor, kind(env, actor, frames_per_batch=num_envs * steps, compile="off", **kwargs)


def shift(actor):
    """Stands for an update."""
    with torch.no_grad():
        for p in actor.parameters():
            p.mul_(1.1)


def kill(collector, which, after=0.0):
    """Ends one of the actors' processes, now or within the next rollout."""
    _, pid = [place for pool in collector.pools for place in pool.places()][which]
    threading.Timer(after, os.kill, (pid, signal.SIGKILL)).start()


@pytest.mark.parametrize(("workers", "memory", "deaths"), [(2, True, 1), (4, False, 0)])
def test_any_number_of_actors_gives_the_numbers_of_one_process_whoever_dies(workers, memory, deaths):
    settings = {"env_id": "Pendulum-v1" if memory else "CartPole-v1", "memory": memory}
    actor, alone = make(1, collectors.VectorCollector, **settings)
    twin, spread = make(workers, **settings)
    for number in range(6):
        if deaths and number == 2:
            kill(spread, which=1, after=0.01)
        assert equal(alone.rollout(), spread.rollout()), number
        shift(actor)
        shift(twin)
        if number == 3:
            state = spread.state_dict()
    assert spread.frames == 6 * 200 and (spread.deaths, spread.lost) == (deaths, 0)
    for collector in (alone, spread):  # a checkpoint of one is one of the other
        collector.load_state_dict(state)
    assert equal(alone.rollout(), spread.rollout())
    spread.shutdown()


class Mill(gym.Env):
    """Observes how many steps its episode has, and a number drawn at its start; there are 20 steps of flour."""

    observation_space, action_space = gym.spaces.Box(0, 1e9, (2,)), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seen = np.array([0, self.np_random.integers(1000)], np.float32)
        return self.seen, {}

    def step(self, action):
        self.seen = self.seen + np.float32([1, 0])
        if self.seen[0] > 20:
            raise UserError("the mill is out of flour")
        return self.seen, 1.0, False, False, {}


def vector_of_mills(num_envs):
    return gym.vector.SyncVectorEnv([Mill] * num_envs)


def test_environments_that_cannot_be_brought_back_begin_new_episodes_and_an_error_in_them_is_told():
    _, collector = make(1, env_id=vector_of_mills, num_envs=3, steps=10)
    before = collector.rollout()
    assert before["next", "observation"][:, -1, 0].tolist() == [10, 10, 10]
    kill(collector, which=0)
    after = collector.rollout()
    assert after["next", "observation"][:, -1, 0].tolist() == [10, 10, 10]
    assert not torch.equal(after["observation"][..., 1], before["observation"][..., 1])  # others than the first ones
    assert (collector.deaths, collector.lost, collector.frames) == (1, 3, 60)
    collector.rollout()
    with pytest.raises(UserError, match="^the mill is out of flour$"):
        collector.rollout()


def test_a_cluster_without_a_place_says_what_it_lacks():
    class Guest:
        def sits(self) -> None: ...

    guest = ray.remote(num_cpus=5)(Guest).remote()
    ray.get(guest.sits.remote())
    _, collector = make(1, wait=1.0)
    with pytest.raises(
        UserError, match=r"1 of 1 collecting .* 1 CPU, the cluster of 1 nodes has 0 of 5 free.* waited 1"
    ):
        collector.rollout()
    ray.kill(guest)
    with pytest.raises(UserError, match="--collectors is for runs on Ray: add --ray"):
        parse(recipes.load(recipes.find("ppo")).Args, {}, ["--collectors", "3"]).processes()


def test_the_wait_for_a_place_begins_where_one_is_missing():
    """An actor that dies in a long evaluation has the whole time to find another."""

    class Giant:
        def sits(self) -> None: ...

    giant = ray.remote(num_cpus=1000)(Giant).remote()
    waiting, there = Waiting("collecting processes", limit=0.3), ray.put(0)
    assert waiting.go_on([there], timeout=1.0)
    time.sleep(0.4)
    assert not waiting.go_on([there, giant.sits.remote()], timeout=0.0)
    time.sleep(0.4)
    with pytest.raises(UserError, match="1 of 2 collecting processes have no place yet"):
        waiting.go_on([there, giant.sits.remote()], timeout=0.0)
    ray.kill(giant)


def test_actors_at_their_own_pace_stay_within_the_bound_also_where_one_dies():
    actor, collector = make(2, asynchronous=True, max_lag=3, num_envs=2, steps=20)
    lags = []
    for number in range(12):
        if number == 4:
            kill(collector, which=0)
        rollout = collector.rollout()
        assert rollout.batch_size == (1, 40)
        lags.append(collector.lag)
        shift(actor)
    assert max(lags) <= 3 and sum(lags) > 0
    assert (collector.frames, collector.deaths, collector.lost) == (12 * 40, 1, 0)
    collector.shutdown()


def trained(recipe, folder, *flags):
    """The rows of a short run's metrics, without its times."""
    module = recipes.load(recipes.find(recipe))
    flags = [*flags, "--env-id", "CartPole-v1", "--eval-every", "0", "--eval-episodes", "1", "--compile", "off"]
    module.main(parse(module.Args, module.PRESETS, [*flags, "--total-frames", "1024", "--run-dir", str(folder)]))
    with open(folder / "metrics.csv") as file:
        return [{k: x for k, x in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]


def test_ppo_on_ray_writes_the_metrics_of_one_process(tmp_path):
    rows = [trained("ppo", tmp_path / name, *flags) for name, flags in (("here", []), ("ray", ["--ray"]))]
    assert len(rows[0]) == 4 and rows[0] == rows[1]


def test_impala_on_ray_logs_its_lag(tmp_path):
    rows = trained("impala", tmp_path / "run", "--ray", "--collectors", "1", "--max-lag", "2")
    lags = [float(row["train/policy_lag"]) for row in rows if row["train/policy_lag"]]
    assert len(lags) == 4 and max(lags) <= 2


def two_pendulums(seed):
    return envs.make("Pendulum-v1", num_envs=2, seed=seed)


def test_torchrls_collector_on_ray_gets_the_weights_before_every_rollout():
    makers = [partial(two_pendulums, seed) for seed in (1, 2)]
    actor = modules.deterministic_actor(makers[0](), (8,))
    collector = collectors.TorchRLCollector(makers, actor, frames_per_batch=40, total_frames=80, backend="ray")
    for rollout in collector:
        assert rollout.batch_size == (4, 10)
        assert len(rollout["observation"][:, 0, 0].unique()) == 4
        torch.testing.assert_close(rollout["action"], actor(rollout.select("observation"))["action"])
        shift(actor)
    assert collector.frames == 80
    collector.shutdown()
