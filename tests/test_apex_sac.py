"""Ape-X SAC: the first priorities, the shards, the explorers' pace, and the recipe with actors that die."""

import json
import logging
import os
import sys
import time
from functools import partial
from types import SimpleNamespace

import pytest
import ray
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit import data, envs, losses, modules, run, updates
from pgkit.cli import recipes
from pgkit.collectors import RayExplorers, connect
from pgkit.data.ray_replay import _Shard
from pgkit.errors import EnvironmentFailed, UserError
from pgkit.messages import shipped
from tests.data.test_replay import hand_made
from tests.recipes.test_ppo import pgkit, rows


@pytest.fixture(scope="module")
def cluster():
    connect(cpus=6)
    yield
    ray.shutdown()


@pytest.fixture
def recipe():
    path = [*sys.path]
    yield recipes.load(recipes.find("apex_sac"))
    sys.path[:] = path


def packed(rollout, error=1.0):
    rollout = rollout.set("td_error", torch.full(rollout.shape, error))
    return {"entries": {k: x.contiguous().numpy() for k, x in rollout.items(True, True)}, "batch": rollout.shape}


def shard(alpha=1.0, capacity=8):
    def make(number):
        sampler = data.Prioritized(alpha=alpha, beta=0.5, eps=0.0)
        return data.ReplayBuffer(envs.make("Pendulum-v1"), capacity, sampler=sampler, seed=number)

    return make


@pytest.mark.filterwarnings("ignore:No target network updater")  # an explorer's targets come with its weights
@pytest.mark.parametrize("n_step", [1, 3])
def test_an_explorer_says_how_wrong_the_critics_are_about_its_own_frames(n_step, recipe):
    args = recipe.Args(env_id="Pendulum-v1", num_envs=2, steps=8, n_step=n_step, hidden=(8,), random_frames=0)
    explorer = recipe.Explorer(args, 1, seed=3, frames=0)
    built = recipe.agent(args, args.make_env(2, 0))
    torch.manual_seed(7)
    rollout = explorer(built.loss.state_dict())
    assert rollout["td_error"].shape == (2, 8)
    torch.manual_seed(7)
    for name, p in built.loss.named_parameters():
        assert torch.equal(p, dict(explorer.loss.named_parameters())[name])
    # by hand: the sum of up to n rewards, up to the rollout's end, and the state that follows them
    reward = torch.stack([
        sum(0.99**k * rollout["next", "reward"][:, t + k] for k in range(min(n_step, 8 - t))) for t in range(8)
    ], 1)  # fmt: skip
    last = torch.tensor([min(t + n_step, 8) - 1 for t in range(8)])
    following = {"observation": rollout["next", "observation"][:, last], "reward": reward}
    following |= {key: torch.zeros(2, 8, 1, dtype=torch.bool) for key in ("done", "terminated")}
    batch = TensorDict(
        {"observation": rollout["observation"], "action": rollout["action"], "next": TensorDict(following, [2, 8])},
        [2, 8],
    )
    if n_step > 1:
        batch["steps_to_next_obs"] = (last - torch.arange(8) + 1.0).view(1, 8, 1).expand(2, 8, 1)
    by_time = batch.transpose(0, 1).reshape(-1)
    built.loss(by_time)
    torch.testing.assert_close(rollout["td_error"].T.flatten(), by_time["td_error"])


def test_explorers_differ_by_their_deviation_and_evaluation_by_none():
    env = envs.make("Pendulum-v1")
    actor = modules.tanh_normal_actor(env, (8,))
    wide = modules.ScaledExploration(actor, 3.0)
    observation = TensorDict({"observation": torch.randn(5, 3)}, [5])
    plain, scaled = actor(observation.clone()), wide(observation.clone())
    torch.testing.assert_close(scaled["scale"], 3 * plain["scale"])
    assert torch.equal(scaled["loc"], plain["loc"])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(actor(observation.clone())["action"], wide(observation.clone())["action"])


def test_a_shard_gives_batches_and_takes_late_errors_of_frames_that_it_still_has():
    made = _Shard(shipped(shard()), 0, 1.0)
    assert made.extend(packed(hand_made([0, 1, 2, 3, 4], [1, 1, 1, 1]), 2.0), updates=3) == (4, 8.0)
    reply = made.sample(2, 8)
    assert reply["updates"] == 3.0 and reply["stored"] == (4, 8.0)
    seen, frames = reply["entries"]["observation"][:, 0], reply["frames"]
    assert (seen == frames).all() and (reply["entries"]["priority_weight"] == 1).all()
    made.extend(packed(hand_made([4, 5, 6, 7, 8, 9, 10], [1] * 6), 1.0), updates=5)  # 0 and 1 leave
    made.write_back(torch.tensor([1, 2, 9]).numpy(), torch.tensor([100.0, 7.0, 0.5]).numpy(), updates=9)
    by_frame = [float(made.sampler.tree.values[frame % made.buffer.rows]) for frame in range(2, 10)]
    assert by_frame == [7, 2, 1, 1, 1, 1, 1, 0.5]
    ages = [float(made.made_at[frame % made.buffer.rows]) for frame in range(2, 10)]
    assert ages == [9, 3, 5, 5, 5, 5, 5, 9]


def test_a_function_goes_to_other_machines_with_the_arguments_that_it_has():
    assert ray.cloudpickle.loads(shipped(partial(shard(capacity=6), 3)))().capacity == 6


def test_the_learner_reads_writes_back_and_goes_on_without_a_shard(cluster, caplog):
    replay = data.RayReplay(shard(capacity=400), shards=2, batch_size=4, batches=3, least=4)
    assert not replay.ready() and len(replay) == 0
    with pytest.raises(UserError, match="no shard of the replay has frames enough"):
        replay.fetch()
    taken = []
    for first in (0, 100):
        number, handle = replay.emptiest(20)
        taken.append(number)
        rollout = packed(hand_made(list(range(first, first + 21)), [float(first)] * 20))
        replay.told(number, handle, 20, ray.get(handle.extend.remote(rollout, 0)))
    assert sorted(taken) == [0, 1] and len(replay) == 40

    env = envs.make("Pendulum-v1")
    actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 2, (8,))
    loss = losses.SACLoss(actor, critics)
    update = updates.OffPolicyUpdate(
        loss, replay, torch.optim.Adam(loss.parameters()), batch_size=4, learning_starts=4, compile="off"
    )
    metrics = update.train(3)
    assert metrics["loss_qvalue"] > 0 and update.updates == replay.updates == 3
    assert replay.data is not None
    assert ((replay.data["observation"][:, 0] >= 100) == (replay.data["next", "reward"][:, 0] == 100)).all()
    frames, counts = torch.tensor(replay._frames).unique(return_counts=True)
    once = frames[counts == 1].tolist()
    errors = dict(zip(replay._frames.tolist(), replay.data["td_error"].tolist(), strict=True))
    values = ray.get(replay._current.shard.priorities.remote(once))
    assert once and values == pytest.approx([errors[frame] for frame in once], rel=1e-6)
    assert replay.age == 0
    update.train(3)
    assert 0 < replay.age <= 3  # the request was made before the first updates

    ray.kill(replay._shards[0])
    for _ in range(20):
        update.train(3)  # from the other shard
    assert "shard 0 of the replay is gone" in caplog.text and len(replay) == 20
    assert replay.emptiest(20)[0] == 0  # it fills first
    with pytest.raises(UserError, match="explorers fill this replay"):
        update(hand_made([0, 1], [1]))
    replay.shutdown()


def test_explorers_keep_the_pace_that_they_are_given(cluster):
    class Sink:
        def extend(self, rollout, updates):
            return len(rollout["entries"]), float(updates)

    def explore(weights):
        following = {key: weights["x"].expand(1, 10, 1) for key in ("episode_reward", "step_count")}
        following["done"] = torch.zeros(1, 10, 1, dtype=torch.bool)
        return TensorDict({"next": TensorDict(following, [1, 10])}, [1, 10])

    def settle(updates):
        explorers.collect(updates)
        while explorers._running:
            time.sleep(0.01)
            explorers.collect(updates)

    handle, told = ray.remote(Sink).remote(), []
    store = SimpleNamespace(emptiest=lambda frames: (0, handle), told=lambda *what: told.append(what))
    explorers = RayExplorers(
        lambda number, seed, frames: explore,
        2,
        store,
        frames_per_call=10,
        total_frames=200,
        frames_per_update=0.5,
    )
    explorers.publish({"x": torch.ones(1)}, 7)
    first = explorers.collect(None)
    assert first is not None and first["next", "step_count"].shape[1:] == (10, 1)
    assert told[0] == (0, handle, 10, (3, 7.0))
    begun = explorers._begun
    settle(0)
    assert explorers.frames == begun + 2 * 10  # one call each besides
    settle(60)
    assert explorers.frames == begun + 2 * 10 + 30  # half a frame for each of 60 updates
    ray.kill(explorers._actors[0])
    while explorers.frames < 200:
        explorers.collect(None)
    assert explorers.frames == 200 and explorers.restarts == 1
    assert explorers.collect(None) is None
    explorers.shutdown()


def test_an_explorer_that_cannot_begin_ends_the_run_and_says_why(cluster, monkeypatch):
    def sinks(number, seed, frames):
        raise UserError("no wind")

    def burns(number, seed, frames):
        return lambda weights: os._exit(1)

    def calls(make):
        store = SimpleNamespace(emptiest=lambda frames: (0, None))
        explorers = RayExplorers(make, 1, store, frames_per_call=10, total_frames=100)
        explorers.publish({}, 0)
        for _ in range(5):
            explorers.collect(None)

    with pytest.raises(UserError, match="^no wind$"):
        calls(sinks)
    monkeypatch.setattr("pgkit.collectors.ray_explorers.MOST_DEATHS", 2)
    with pytest.raises(EnvironmentFailed, match="explorer 0 ended 2 times at the same call"):
        calls(burns)


def test_the_recipe_trains_with_deaths_and_resumes(cluster, tmp_path, caplog, monkeypatch, recipe):
    small = ["--env-id", "Pendulum-v1", "--batch-size", 32, "--hidden", 16, "--compile", "off", "--threads", 1]
    small += ["--eval-every", 300, "--eval-episodes", 1, "--log-every", 50, "--random-frames", 100, "--steps", 10]
    flags = [*small, "--explorers", 2, "--shards", 2, "--run-dir", tmp_path / "run"]
    held, plain = {}, run.Run.track

    def track(self, **tracked):
        held.update(tracked)
        plain(self, **tracked)

    def step(self, *args, plain=run.Run.step, **kwargs):
        if held.get("update") is not None and held["update"].updates >= 80:
            ray.kill(held["update"].buffer._shards[0])
            ray.kill(held["collector"]._actors[1])
            held.clear()
            monkeypatch.setattr(run.Run, "step", plain)
        return plain(self, *args, **kwargs)

    monkeypatch.setattr(run.Run, "track", track)
    monkeypatch.setattr(run.Run, "step", step)
    with caplog.at_level(logging.WARNING):
        pgkit("run", "apex_sac", *flags, "--total-frames", 600)
    assert "shard 0 of the replay is gone" in caplog.text and "explorer 1 is gone" in caplog.text
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["frames"] == 600 and summary["recipe"] == "apex_sac"
    trained = [row for row in rows(tmp_path / "run") if row["train/loss_qvalue"]]
    assert len(trained) > 5 and float(trained[-1]["replay/priority_age"]) > 0
    one = ["--explorers", 1, "--shards", 1, "--resume-if-possible", "--run-dir", tmp_path / "run"]
    pgkit("run", "apex_sac", *one, "--total-frames", 900)
    done = rows(tmp_path / "run")
    assert done[-1]["frames"] == "900" and sum(bool(row["train/loss_qvalue"]) for row in done) > len(trained)
    assert run.load_policy(tmp_path / "run").predict(torch.zeros(3).numpy()).shape == (1,)
