"""Collecting on Ray: the numbers of one process, whatever the actors' number and whoever of them dies."""

import os
import signal

import pytest
import ray
import torch

from pgkit import collectors, envs, modules


@pytest.fixture(scope="module", autouse=True)
def cluster():
    """One small cluster for all tests; its processes and its shared memory are gone after them."""
    os.environ["RAY_worker_niceness"] = "0"
    ray.init(address="local", num_cpus=8, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    yield
    ray.shutdown()


def equal(a, b):
    return set(a.keys(True, True)) == set(b.keys(True, True)) and bool((a == b).all())


def make(workers, kind=None, env_id="CartPole-v1", num_envs=4, steps=25, **kwargs):
    torch.manual_seed(0)
    env = envs.make(env_id, num_envs=num_envs, seed=3, workers=workers)
    build = modules.gaussian_actor if env.action_spec.dtype.is_floating_point else modules.categorical_actor
    actor = build(env, normalizer=modules.ObsNormalizer(env))
    kind = kind or collectors.RayCollector
    return actor, kind(env, actor, frames_per_batch=num_envs * steps, compile="off", **kwargs)


def shift(actor):
    with torch.no_grad():
        for p in actor.parameters():
            p.mul_(1.1)


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_any_number_of_actors_gives_the_numbers_of_one_process(workers):
    rollouts = []
    for kind, processes in ((collectors.VectorCollector, 1), (collectors.RayCollector, workers)):
        actor, collector = make(processes, kind)
        made = []
        for _ in range(3):
            made.append(collector.rollout())
            shift(actor)
        rollouts.append(made)
        collector.shutdown()
    assert all(equal(a, b) for a, b in zip(*rollouts, strict=True))
