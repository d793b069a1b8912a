"""Recurrent agents: what collects and what trains are the same network."""

from typing import Any

import pytest
import torch

from pgkit import advantages, collectors, envs, losses, modules, run, updates
from pgkit.errors import UserError
from pgkit.run.evaluate import Acting


def make(core=modules.gru, workers=1, steps=32, **settings):
    torch.manual_seed(0)
    env = envs.make("CartPole-v1", num_envs=4, seed=3, workers=workers)
    memory = core(env, 8, (8,))
    actor, critic = modules.categorical_actor(env, encoder=memory), modules.state_value(env, encoder=memory)
    with torch.no_grad():
        actor.get_submodule("module.0.module.head").weight.mul_(300)  # so that a wrong memory shows
    loss = losses.ClipPPOLoss(actor, critic)
    settings = {"epochs": 1, "minibatch_size": 64, "sequence_length": 8, "compile": "off", "seed": 0} | settings
    update = updates.OnPolicyUpdate(
        loss, advantages.GAE(critic), torch.optim.SGD(loss.parameters(), lr=0.0), **settings
    )
    collector = collectors.VectorCollector(env, actor, frames_per_batch=4 * steps, compile="off")
    return actor, update, collector


def equal(a, b):
    return set(a.keys(True, True)) == set(b.keys(True, True)) and bool((a == b).all())


@pytest.mark.parametrize("core", [modules.gru, modules.lstm])
def test_the_ratio_is_one_before_the_first_step(core):
    _, update, collector = make(core)
    collector.rollout()  # episodes are under way where the next one begins
    rollout = collector.rollout()
    assert rollout["is_init"].sum() > 2 and not rollout["is_init"][:, 0].all()
    metrics = update(rollout)
    assert metrics["approx_kl"] == pytest.approx(0, abs=1e-9) and metrics["clip_fraction"] == 0
    # and it is not where the memory is not put to zero at the start of an episode
    assert update(rollout.set("is_init", torch.zeros_like(rollout["is_init"])))["approx_kl"] > 1e-4


def test_the_collector_empties_the_memory_at_the_start_of_an_episode():
    actor, _, collector = make(steps=64)
    rollout = collector.rollout()
    begins = rollout["is_init"][..., 0]
    assert torch.equal(begins[:, 1:], rollout["next", "done"][:, :-1, 0]) and begins[:, 0].all()
    assert torch.equal(rollout["recurrent_state"][:, 1:], rollout["next", "recurrent_state"][:, :-1])
    rows = rollout[begins].select(*actor.in_keys)
    assert len(rows) > 8 and (rows["recurrent_state"].abs().sum(-1) > 0).sum() > 4
    rows["recurrent_state"].zero_()
    after = actor(rows)["next", "recurrent_state"]
    torch.testing.assert_close(rollout["next", "recurrent_state"][begins], after)
    carried_on = rollout[begins].select(*actor.in_keys).set("is_init", torch.zeros(len(rows), 1, dtype=torch.bool))
    assert (actor(carried_on)["next", "recurrent_state"] - after).abs().max() > 0.05


def test_workers_and_resumes_do_not_change_the_numbers():
    rollouts = []
    for workers in (1, 2):
        _, _, collector = make(workers=workers)
        first, state = collector.rollout(), collector.state_dict()
        rollouts.append((first, collector.rollout()))
        collector.shutdown()
        _, _, other = make(workers=3 - workers)
        other.load_state_dict(state)
        assert equal(other.rollout(), rollouts[-1][1])
        other.shutdown()
    assert equal(rollouts[0][0], rollouts[1][0]) and equal(rollouts[0][1], rollouts[1][1])


def test_torchrls_collector_carries_the_memory_too():
    actor, update, own = make()
    collector = collectors.TorchRLCollector(own.env, actor, frames_per_batch=128, total_frames=256)
    _, rollout = list(collector)
    assert set(own.rollout().keys(True, True)) <= set(rollout.keys(True, True))
    assert rollout["is_init"].sum() > 2 and not rollout["is_init"][:, 0].all()
    assert update(rollout)["approx_kl"] == pytest.approx(0, abs=1e-9)
    collector.shutdown()


def test_compiled_sequences_agree():
    results = []
    for compile in ("on", "off"):
        _, update, collector = make(sequence_length=4, minibatch_size=None, epochs=2, compile=compile)
        update.optimizer.param_groups[0]["lr"] = 1e-2
        results.append([update(collector.rollout()) for _ in range(2)])
    for a, b in zip(*results, strict=True):
        assert a == pytest.approx(b, rel=1e-3, abs=1e-5)


def test_the_final_value_is_that_of_the_memory_after_the_last_step():
    # a truncation's bootstrap: one more step of the core, from the state after the last step, on the final observation
    _, update, collector = make()
    rollout = collector.rollout()
    estimate: Any = update.advantage
    critic = estimate.critic
    last = rollout["next"][:, -1].select(*critic.in_keys)
    assert not last["is_init"].any()
    estimate(rollout)
    delta = rollout["next", "reward"] - rollout["state_value"]
    expected = delta[:, -1] + 0.99 * critic(last.clone())["state_value"] * ~rollout["next", "terminated"][:, -1]
    torch.testing.assert_close(rollout["advantage"][:, -1], expected)


def test_evaluation_and_prediction_remember_and_forget():
    actor, _, _ = make()
    env = envs.make("CartPole-v1", num_envs=2, seed=5)
    fresh, acting = env.simulator.reset(), Acting(actor)
    obs, begun = fresh["observation"].clone(), torch.ones(2, dtype=torch.bool)
    acting(fresh, begun)
    first = acting.state
    acting(fresh, ~begun)
    assert not torch.equal(acting.state, first)
    acting(fresh, begun)
    assert torch.equal(acting.state, first)
    assert run.play(actor, env, 4)[1].min() > 0

    policy = run.Policy(actor, envs.make, (4,))
    policy.predict(obs.numpy())
    assert torch.equal(policy._acting.state, first)
    policy.predict(obs.numpy())
    assert not torch.equal(policy._acting.state, first)
    policy.reset()
    policy.predict(obs.numpy())
    assert torch.equal(policy._acting.state, first)


def test_mistakes():
    with pytest.raises(UserError, match="minibatch_size=60 is not a multiple of sequence_length=8"):
        make(minibatch_size=60)
    _, update, collector = make(sequence_length=None)
    with pytest.raises(
        UserError, match="single rows do not train their memory: use OnPolicyUpdate with sequence_length="
    ):
        update(collector.rollout())
    _, update, collector = make(steps=20)
    with pytest.raises(UserError, match="sequence_length=8 does not divide the 20 steps"):
        update(collector.rollout())
    actor, update, collector = make()
    other = modules.state_value(collector.env, encoder=modules.gru(collector.env, 8, (8,)))
    loss = losses.ClipPPOLoss(actor, other)
    optimizer = torch.optim.Adam(loss.parameters())
    with pytest.raises(UserError, match="a recurrent core of its own, the rollout has the state of the actor's only"):
        updates.OnPolicyUpdate(loss, advantages.GAE(other), optimizer, sequence_length=8)(collector.rollout())
