"""Collecting beside the update: the same numbers as in turn, with weights one update old; lag bounded and counted."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from pgkit import advantages, collectors, envs, losses, modules, updates
from pgkit.errors import UserError


def make(workers=1, num_envs=4, steps=20, seed=3, **kwargs):
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=num_envs, seed=seed, workers=workers)
    actor = modules.gaussian_actor(env)
    share = num_envs // workers if kwargs.get("per_worker") else num_envs
    return actor, collectors.AsyncCollector(env, actor, frames_per_batch=share * steps, compile="off", **kwargs)


def shift(actor):
    """Stands for an update: moves every action by about the same."""
    with torch.no_grad():
        for param in actor.parameters():
            param.add_(0.1)


def equal(a, b):
    return set(a.keys(True, True)) == set(b.keys(True, True)) and bool((a == b).all())


def test_the_first_rollouts_are_those_of_the_collector_in_turn_and_then_one_update_behind():
    actor, ahead = make()
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=4, seed=3)
    same = modules.gaussian_actor(env)
    in_turn = collectors.VectorCollector(env, same, frames_per_batch=80, compile="off")
    lags = []
    for number in range(4):
        rollout = ahead.rollout()
        lags.append(ahead.lag)
        assert equal(rollout, in_turn.rollout()), number
        shift(actor)
        if number:
            shift(same)  # one update later than the other's
    assert lags == [0, 1, 1, 1]
    assert ahead.frames == 320
    ahead.shutdown()


def ppo(num_envs=4, workers=1):
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=num_envs, seed=3, workers=workers)
    normalizer = modules.ObsNormalizer(env)
    actor = modules.gaussian_actor(env, (16,), normalizer=normalizer)
    critic = modules.state_value(env, (16,), normalizer=normalizer)
    adam = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=0.01)
    loss, gae = losses.ClipPPOLoss(actor, critic), advantages.GAE(critic, gamma=0.9, lmbda=0.9)
    update = updates.OnPolicyUpdate(loss, gae, adam, epochs=2, minibatch_size=20, compile="off", seed=5)
    return env, normalizer, actor, update


def test_ppo_beside_the_update_equals_a_plain_loop_with_weights_one_update_old():
    env, normalizer, actor, update = ppo(workers=2)
    ahead, metrics = collectors.AsyncCollector(env, actor, frames_per_batch=80, compile="off"), []
    for _ in range(4):
        rollout = ahead.rollout()
        metrics.append(update(rollout))
        normalizer.update(rollout["observation"])
    ahead.shutdown()

    env, normalizer, plain, update = ppo()
    _, _, behind, _ = ppo()  # the actor that collects
    in_turn, expected = collectors.VectorCollector(env, behind, frames_per_batch=80, compile="off"), []
    for number in range(4):
        rollout = in_turn.rollout()
        given = rollout.select("observation", "action", "action_log_prob")
        collected = behind.get_dist(given).log_prob(given["action"])
        torch.testing.assert_close(given["action_log_prob"], collected)  # the ratio's denominator
        ratio = (plain.get_dist(given).log_prob(given["action"]) - collected).detach().exp()
        assert bool((ratio == 1).all()) == (number == 0)
        now = {key: x.clone() for key, x in plain.state_dict().items()}
        expected.append(update(rollout))
        normalizer.update(rollout["observation"])
        behind.load_state_dict(now)
    assert metrics == expected
    assert all(torch.equal(x, y) for x, y in zip(actor.state_dict().values(), plain.state_dict().values(), strict=True))


def test_two_workers_of_whole_rollouts_give_the_numbers_of_one():
    rollouts = []
    for workers in (1, 2):
        actor, collector = make(workers)
        out = []
        for _ in range(3):
            out.append(collector.rollout())
            shift(actor)
        rollouts.append(torch.stack(out))
        collector.shutdown()
    assert equal(*rollouts)


def test_forced_delay_adds_to_the_lag():
    actor, collector = make(delay=3)
    lags = []
    for _ in range(7):
        collector.rollout()
        lags.append(collector.lag)
        shift(actor)
    assert lags == [0, 1, 2, 3, 4, 4, 4]
    collector.shutdown()


def test_workers_deliver_by_themselves_within_the_bound():
    _, collector = make(workers=2, per_worker=True, max_lag=3)
    rollouts = [collector.rollout() for _ in range(12) if collector.lag <= 3]
    assert len(rollouts) == 12 and collector.lag <= 3
    assert all(rollout.batch_size == (2, 20) for rollout in rollouts)
    assert collector.frames == 12 * 40
    collector.shutdown()


@pytest.mark.parametrize("per_worker", [False, True])
def test_a_checkpoint_in_between_changes_nothing(per_worker):
    settings = {"workers": 2, "per_worker": per_worker, "max_lag": 2, "delay": 1}
    straight = []
    for interrupted in (False, True):
        actor, collector = make(**settings)
        out = []
        for number in range(6):
            if interrupted and number == 3:
                state, weights = collector.state_dict(), actor.state_dict()
                collector.shutdown()
                actor, collector = make(**settings)
                actor.load_state_dict(weights)
                collector.load_state_dict(state)
            out.append(collector.rollout())
            shift(actor)
        straight.append(torch.stack(out))
        collector.shutdown()
    assert equal(*straight)


def test_a_run_goes_on_after_a_rollout_that_could_not_be_handed_out():
    class Breaks(gym.Env):
        """Its seventh observation is NaN."""

        observation_space, action_space, steps = gym.spaces.Box(0, 100, (1,)), gym.spaces.Box(-1, 1, (1,)), 0

        def reset(self, *, seed=None, options=None):
            return np.zeros(1, np.float32), {}

        def step(self, action):
            self.steps += 1
            return np.float32([np.nan if self.steps == 7 else self.steps]), 0.0, False, False, {}

    env = envs.make(Breaks)
    actor = modules.gaussian_actor(env)
    collector = collectors.AsyncCollector(env, actor, frames_per_batch=4, compile="off")
    collector.rollout()
    with pytest.raises(UserError, match=r"'next.observation' of environment 0 is nan at step 2"):
        collector.rollout()
    state = collector.state_dict()
    assert collector.rollout()["next", "observation"].flatten().tolist() == [9, 10, 11, 12]
    collector.shutdown()
    collector = collectors.AsyncCollector(env, actor, frames_per_batch=4, compile="off")
    collector.load_state_dict(state)
    assert collector.rollout()["next", "observation"].flatten().tolist() == [9, 10, 11, 12]
    collector.shutdown()


def test_random_frames_come_first():
    _, collector = make(init_random_frames=100)
    kinds = [bool(collector.rollout()["action_log_prob"].isnan().all()) for _ in range(3)]
    assert kinds == [True, True, False]
    collector.shutdown()


def test_refusals():
    with pytest.raises(UserError, match=r"max_lag=1 .* 2 workers"):
        make(workers=2, per_worker=True, max_lag=1)
    with pytest.raises(UserError, match="each worker has as many"):
        make(workers=3, num_envs=4, per_worker=True)
