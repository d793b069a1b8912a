"""Critic blocks inside the compiled update: the numbers of eager code, fresh random numbers, statistics that last."""

import copy
from functools import partial

import pytest
import torch

from pgkit import collectors, data, envs, heads, losses, modules, updates
from pgkit.run.evaluate import act

BLOCKS = {
    "redq": ({"num_critics": 5}, {"subset": 2, "actor_value": "mean"}),
    "redq of all": ({"num_critics": 2}, {"subset": 2, "actor_value": "mean"}),
    "tqc": ({"num_critics": 3, "head": heads.Quantiles(5)}, {"actor_value": "mean"}),
    "droq": ({"norm": modules.EnsembleLayerNorm, "dropout": 0.2}, {}),
    "crossq": ({"body": partial(modules.batch_renorm_mlp, hidden=(16,))}, {}),
    "simba": ({"body": partial(modules.simba, width=16, blocks=1)}, {}),
    "bins": ({"head": heads.Bins(-50, 50, 21)}, {"subset": 1}),
    "categorical": ({"head": heads.Categorical(-50, 50, 21)}, {}),
}


def agent(block, compile="off", seed=0, **kwargs):
    torch.manual_seed(seed)
    env = envs.make("Pendulum-v1", 1)
    critic, settings = BLOCKS[block]
    encoder, normalizer = None, modules.ObsNormalizer(env) if block == "simba" else None
    if block in ("simba", "crossq"):
        encoder = modules.Encoder(env, critic["body"])
    actor = modules.tanh_normal_actor(env, (16,), encoder=encoder, normalizer=normalizer)
    critics = modules.q_value(env, **{"num_critics": 2, "hidden": (16,), "normalizer": normalizer, **critic})
    make = losses.CrossQLoss if block == "crossq" else losses.SACLoss
    loss = make(actor, critics, gamma=0.9, **settings)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    update = updates.OffPolicyUpdate(
        loss,
        data.ReplayBuffer(env, 500, seed=0),
        optimizer,
        compile=compile,
        **{"batch_size": 32, "learning_starts": 64, "updates_per_step": 0.1, **kwargs},
    )
    return update, collectors.VectorCollector(env, actor, frames_per_batch=32), normalizer


def state(update):
    return {k: v.detach().clone() for k, v in update.loss.state_dict().items() if isinstance(v, torch.Tensor)}


def train(update, collector, normalizer, rollouts=4):
    for _ in range(rollouts):
        rollout = collector.rollout()
        if normalizer is not None:
            normalizer.update(rollout["observation"])
        metrics = update(rollout)
    return metrics


@pytest.mark.parametrize(
    "block", [b if b in ("crossq", "redq") else pytest.param(b, marks=pytest.mark.slow) for b in BLOCKS]
)  # a compilation each: two of them in every run, the others with -m slow
def test_eager_equals_compiled(block):
    results = []
    for compile in ("off", "on"):
        update, *rest = agent(block, compile)
        metrics = train(update, *rest)
        results.append((state(update), metrics))
        assert (update.compile_seconds > 0) == (compile == "on")
    (eager, numbers), (compiled, others) = results
    for key, value in eager.items():
        torch.testing.assert_close(compiled[key], value, rtol=1e-3, atol=1e-4, msg=lambda m, k=key: f"{k}: {m}")
    assert numbers == pytest.approx(others, rel=1e-2, abs=1e-2)


@pytest.mark.parametrize("block", ["redq", "droq"])
def test_the_compiled_step_draws_anew_each_time(block):
    """With a learning rate of 0 and one batch again and again, only subset, dropout and actions change the loss."""
    update, collector, _ = agent(block, "on", updates_per_step=1, tau=0.0)
    for group in update.optimizer.param_groups:
        group["lr"] = 0.0
    update.loss.gamma.fill_(0.0 if block == "droq" else 0.9)
    actor = update.loss.actor_network
    for module in actor.modules():
        if hasattr(module, "low"):
            module.low = module.high = -20.0  # a policy without noise
    for target in update.loss.target_qvalue_network_params.values(True, True):
        target.data.add_(torch.randn_like(target))  # critics that differ
    for _ in range(2):
        update.buffer.extend(collector.rollout())
    index = update.buffer.sample_index(32)[0]
    update.train(1)
    assert update._plan is not None
    values = {round(update._plan.every(update.buffer.data, index)[1].item(), 4) for _ in range(30)}
    # redq: 10 pairs of 5, whose minima differ; droq: masks of their own in each of 30 steps
    assert len(values) > (3 if block == "redq" else 25), values


@pytest.mark.parametrize("compile", ["off", "on"])
def test_running_statistics_move_in_the_step_and_travel(compile):
    update, collector, _ = agent("crossq", compile)
    train(update, collector, None)
    steps = {k: v for k, v in state(update).items() if k.endswith("steps")}
    assert steps and all((v == update.updates).all() for v in steps.values())  # the check before the first is undone
    # the actor that collects and is evaluated holds the same statistics, and so does a copy made of its state
    own = {k: v for k, v in collector.actor.state_dict().items() if k.endswith(("mean", "var"))}
    assert own and all(v.ne(0).any() for v in own.values())
    twin = agent("crossq", seed=1)[1].actor
    twin.load_state_dict(collector.actor.state_dict())
    observation = collector.env.observation_spec["observation"].rand().numpy()
    before = state(update)
    actions = [act(actor, observation) for actor in (collector.actor, twin)]
    assert (actions[0] == actions[1]).all()
    assert all(torch.equal(v, state(update)[k]) for k, v in before.items())


def test_statistics_reach_the_target():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", 1)
    actor = modules.tanh_normal_actor(env, (8,))
    loss = losses.SACLoss(actor, modules.q_value(env, body=partial(modules.batch_renorm_mlp, hidden=(8,))))
    update = updates.OffPolicyUpdate(
        loss, data.ReplayBuffer(env, 100), torch.optim.Adam(loss.parameters()), batch_size=16, learning_starts=16,
        compile="off",
    )  # fmt: skip
    update(collectors.VectorCollector(env, actor, frames_per_batch=32).rollout())
    key = ("module", "layers", "0", "mean")
    source = loss.qvalue_network_params.get(key)
    assert source.ne(0).any() and torch.equal(loss.target_qvalue_network_params.get(key), source)


@pytest.mark.parametrize("block", ["crossq", "redq", "droq", "simba"])
def test_resumed_with_its_buffer_it_goes_on_bit_for_bit(block):
    straight, collector, normalizer = agent(block)
    train(straight, collector, normalizer, 3)
    other, twin, its = agent(block, seed=1)
    twin.actor.load_state_dict(collector.actor.state_dict())
    other.load_state_dict(copy.deepcopy(straight.state_dict()))
    other.buffer.load_state_dict(straight.buffer.state_dict())
    twin.load_state_dict(collector.state_dict())
    finals = []
    for update, source, moments in ((straight, collector, normalizer), (other, twin, its)):
        torch.manual_seed(5)
        train(update, source, moments, 2)
        finals.append(state(update))
    assert all(torch.equal(v, finals[1][k]) for k, v in finals[0].items())
