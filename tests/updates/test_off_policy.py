"""The off-policy update: eager equals compiled, targets, delay, priorities, TorchRL's parts, learning."""

import copy

import gymnasium as gym
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform
from torchrl.objectives import SACLoss as TorchRLSACLoss

from pgkit import collectors, controllers, data, envs, heads, losses, modules, updates
from pgkit.errors import UserError
from pgkit.updates.batches import OwnBatches
from pgkit.updates.targets import averaging
from tests.data.test_replay import hand_made


def agent(
    compile="off", *, seed=0, buffer=None, loss="pgkit", num_envs=1, optimizer=torch.optim.Adam, unit=False, **kwargs
):
    torch.manual_seed(seed)
    env = envs.make("Pendulum-v1", num_envs)
    actor, critics = modules.tanh_normal_actor(env, (16,)), modules.q_value(env, hidden=(16,))
    if unit:
        kwargs["project"] = modules.WeightProjection(actor, critics)
    if loss == "pgkit":
        module = losses.SACLoss(actor, critics, gamma=0.9)
    else:
        module = TorchRLSACLoss(actor, [modules.q_value(env, 1, (16,)) for _ in range(2)], target_entropy=-1.0)
        module.make_value_estimator(gamma=0.9)
    buffer = data.ReplayBuffer(env, 500, seed=0) if buffer is None else buffer(env)
    settings = {"batch_size": 32, "learning_starts": 64, **kwargs}
    update = updates.OffPolicyUpdate(
        module, buffer, optimizer(module.parameters(), lr=1e-2), compile=compile, **settings
    )
    return update, collectors.VectorCollector(env, actor, frames_per_batch=32 * num_envs)


def weights(update):
    return torch.cat(
        [x.detach().flatten().float() for x in update.loss.state_dict().values() if isinstance(x, torch.Tensor)]
    )


def train(update, collector, rollouts=4):
    for _ in range(rollouts):
        metrics = update(collector.rollout())
    return metrics


def prioritized(n_steps=1):
    return lambda env: data.ReplayBuffer(env, 500, sampler=data.Prioritized(), n_steps=n_steps, seed=0)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"buffer": prioritized(3), "actor_delay": 2, "max_grad_norm": 1.0},
        {"loss": "torchrl"},
        {"buffer": lambda env: TensorDictReplayBuffer(storage=LazyTensorStorage(500), batch_size=32)},
        {"unit": True, "actor_delay": 2},
    ],
    ids=[
        "plain",
        "prioritized, 3 steps, delayed actor",
        "TorchRL's loss",
        "TorchRL's replay buffer",
        "weights of unit length, delayed actor",
    ],
)
def test_eager_equals_compiled(settings):
    results = []
    for compile in ("off", "on"):
        update, collector = agent(compile, updates_per_step=0.15, **settings)  # few, as rounding may change a draw
        metrics = train(update, collector)
        results.append((weights(update), metrics))
        assert (update.compile_seconds > 0) == (compile == "on")
        assert update._plan is not None
        for step in (update._plan.every, update._plan.critics):
            assert step.native[0].rung == ("recorded and compiled" if compile == "on" else "eager")
    (a, eager), (b, compiled) = results
    torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)
    assert eager == pytest.approx(compiled, rel=1e-2, abs=1e-2)


def test_targets_follow_by_tau_and_nothing_trains_before_learning_starts():
    update, collector = agent(tau=0.25)
    assert train(update, collector, 1) == {} and update.updates == 0
    update.buffer.extend(collector.rollout())
    key = ("module", "layers", "0", "weight")
    before = update.loss.target_qvalue_network_params.get(key).clone()
    update.train(1)
    after, source = update.loss.target_qvalue_network_params.get(key), update.loss.qvalue_network_params.get(key)
    torch.testing.assert_close(after, before + 0.25 * (source - before))
    assert not torch.equal(after, before)


def test_targets_have_rates_of_their_own():
    """The innermost name in a parameter's path holds."""
    update, collector = agent(tau={"qvalue_network": 0.25, "2": 0.5})
    update.buffer.extend(collector.rollout())
    update.buffer.extend(collector.rollout())
    keys = {layer: ("module", "layers", layer, "weight") for layer in ("0", "2")}
    before = {layer: update.loss.target_qvalue_network_params.get(key).clone() for layer, key in keys.items()}
    update.train(1)
    for layer, tau in (("0", 0.25), ("2", 0.5)):
        after, source = (
            params.get(keys[layer])
            for params in (update.loss.target_qvalue_network_params, update.loss.qvalue_network_params)
        )
        torch.testing.assert_close(after, before[layer] + tau * (source - before[layer]))
        assert not torch.equal(after, before[layer])
    assert "targets move by 0.25 (qvalue_network) and 0.5 (2)" in str(update)
    with pytest.raises(UserError, match="tau names 'encoder', which is no part of a target: they are qvalue_network"):
        agent(tau={"qvalue_network": 0.25, "encoder": 0.5})
    with pytest.raises(UserError, match=r"no rate for 'qvalue_network.module.layers.0.\w+': name 'qvalue_network"):
        agent(tau={"2": 0.5})
    with pytest.raises(UserError, match="tau of qvalue_network=2: give a number from 0 to 1"):
        agent(tau={"qvalue_network": 2.0})


@pytest.mark.parametrize("own", [True, False], ids=["pgkit's replay", "TorchRL's"])
def test_accumulated_batches_are_one_larger_one(own):
    finals = []
    for batch_size, accumulate in ((32, 1), (16, 2)):
        torch.manual_seed(0)
        env = envs.make("Pendulum-v1")
        actor = modules.deterministic_actor(env, (8,))
        loss = losses.DDPGLoss(actor, modules.q_value(env, 1, (8,)))
        theirs = TensorDictReplayBuffer(storage=LazyTensorStorage(500), batch_size=32)
        update = updates.OffPolicyUpdate(
            loss, data.ReplayBuffer(env, 500, seed=0) if own else theirs, torch.optim.SGD(loss.parameters(), lr=0.1),
            batch_size=batch_size, accumulate=accumulate, learning_starts=64, updates_per_step=0.05, compile="off",
        )  # fmt: skip
        collector = collectors.VectorCollector(env, actor, frames_per_batch=64, compile="off")
        torch.manual_seed(1)
        metrics = [update(collector.rollout()) for _ in range(2)]
        means = {name: value for name, value in metrics[-1].items() if not name.endswith("_max")}  # of fewer rows
        finals.append((weights(update), means))
    torch.testing.assert_close(finals[0][0], finals[1][0], rtol=1e-4, atol=1e-5)
    assert finals[0][1] == pytest.approx(finals[1][1], rel=1e-3)


def test_an_augmentation_changes_what_the_loss_reads_and_not_what_is_stored():
    seen = []

    def augment(batch):
        seen.append(batch["observation"].clone())
        return batch.set("observation", torch.zeros_like(batch["observation"]))

    update, collector = agent(augment=augment)
    forward = update.loss.forward
    read = []
    update.loss.forward = lambda batch: (read.append(batch["observation"].clone()), forward(batch))[1]
    train(update, collector, 3)
    assert seen and all(x.abs().sum() > 0 for x in seen)
    assert all((x == 0).all() for x in read[1:])  # the first is the check before the first step
    stored = update.buffer.data["observations"]["observation"][:64]
    assert (stored != 0).any(-1).all()


@pytest.mark.parametrize(("rate", "expected"), [(1.0, 96), (0.5, 48), (0.3, 28)])
def test_updates_per_step(rate, expected):
    update, collector = agent(updates_per_step=rate)  # 128 frames; the first 32 are too few to start
    train(update, collector)
    assert update.updates == expected


def test_actor_delay_leaves_actor_and_temperature_alone_in_between():
    update, collector = agent(actor_delay=2)
    update.buffer.extend(collector.rollout())
    update.buffer.extend(collector.rollout())

    def actor():
        return torch.cat(
            [*(p.detach().flatten() for p in collector.actor.parameters()), update.loss.log_alpha.detach()[None]]
        )

    def critic():
        return update.loss.qvalue_network_params.get(("module", "layers", "0", "weight")).detach().clone()

    start, first = actor(), critic()
    update.train(1)
    second, between = actor(), critic()
    update.train(1)
    assert not torch.equal(start, second) and not torch.equal(first, between)
    assert torch.equal(second, actor()) and not torch.equal(between, critic())


def test_an_optimizer_without_a_functional_form_steps_outside():
    update, collector = agent(optimizer=torch.optim.Adamax, actor_delay=2)
    before = weights(update)
    train(update, collector)
    assert not torch.equal(before, weights(update))


def test_learning_rates_of_groups():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, hidden=(8,))
    temperature = controllers.Temperature(-1.0)
    loss = losses.SACLoss(actor, critics, temperature=temperature)
    groups = [
        {"params": list(m.parameters()), "lr": lr} for m, lr in ((actor, 0.0), (critics, 1e-2), (temperature, 1e-3))
    ]
    update = updates.OffPolicyUpdate(
        loss, data.ReplayBuffer(env, 100), torch.optim.Adam(groups), batch_size=16, learning_starts=16, compile="off"
    )
    before = [p.clone() for p in actor.parameters()]
    update(collectors.VectorCollector(env, actor, frames_per_batch=32).rollout())
    assert all(torch.equal(p, q) for p, q in zip(before, actor.parameters(), strict=True))
    assert 0 < abs(temperature.log_alpha.item()) <= 0.033


def test_priorities_are_written_back():
    update, collector = agent(buffer=prioritized())
    train(update, collector)
    assert update.buffer.sampler is not None
    values = update.buffer.sampler.tree.values[: update.buffer.written]
    assert values.unique().numel() > 60


@pytest.mark.parametrize("loss", ["pgkit", "torchrl"])
def test_takes_torchrl_s_replay_buffer(loss):
    kinds = (ReplayBuffer, TensorDictReplayBuffer)
    for kind in kinds:
        update, collector = agent(
            buffer=lambda env, k=kind: k(storage=LazyTensorStorage(500), batch_size=32), loss=loss
        )
        before = weights(update)
        metrics = train(update, collector)
        assert not torch.equal(before, weights(update)) and {"loss_actor", "loss_qvalue"} <= metrics.keys()


def test_resumed_with_its_buffer_it_goes_on_bit_for_bit():
    straight, collector = agent(num_envs=2)
    train(straight, collector, 3)
    other, twin = agent(seed=1, num_envs=2)
    other.load_state_dict(copy.deepcopy(straight.state_dict()))
    other.buffer.load_state_dict(straight.buffer.state_dict())
    twin.load_state_dict(collector.state_dict())
    finals = []
    for update, source in ((straight, collector), (other, twin)):
        torch.manual_seed(5)
        train(update, source, 2)
        finals.append(weights(update))
    assert torch.equal(*finals)


def test_refusals():
    with pytest.raises(UserError, match="batch_size=128 is above the learning_starts=64 frames stored"):
        agent(batch_size=128)
    with pytest.raises(UserError, match="at most 500 frames to draw from and updates begin at learning_starts=501"):
        agent(learning_starts=501)
    with pytest.raises(UserError, match="at most 50 frames"):
        agent(buffer=lambda _: TensorDictReplayBuffer(storage=LazyTensorStorage(50)))
    with pytest.raises(UserError, match="at most 60 frames"):
        agent(buffer=lambda env: data.ReplayBuffer(env, 64, n_steps=3), num_envs=2)
    with pytest.raises(UserError, match="total_frames=63 end before updates begin at learning_starts=64"):
        agent(total_frames=63)


@pytest.mark.slow
def test_learns_pendulum():
    torch.manual_seed(1)
    env = envs.make("Pendulum-v1", seed=1)
    actor = modules.tanh_normal_actor(env, (64, 64))
    loss = losses.SACLoss(actor, modules.q_value(env, hidden=(64, 64)), gamma=0.98)
    update = updates.OffPolicyUpdate(
        loss,
        data.ReplayBuffer(env, 10_000),
        torch.optim.Adam(loss.parameters(), lr=1e-3),
        learning_starts=500,
        compile="on",
    )
    collector = collectors.VectorCollector(env, actor, frames_per_batch=1, total_frames=6_000, init_random_frames=500)
    returns = []
    for rollout in collector:
        update(rollout)
        if rollout["next", "done"].any():
            returns.append(rollout["next", "episode_reward"].item())
    assert sum(returns[-5:]) / 5 > -300, returns


def test_compiled_writes_to_scalars_outlive_the_step():
    """A compiled graph silently loses writes to a float64 scalar; the largest priority is therefore ``[1]``."""
    update, collector = agent("on", buffer=prioritized())
    update.buffer.extend(collector.rollout())
    update.train(1)
    sampler = update.buffer.sampler
    assert sampler is not None and sampler.largest.item() == sampler.tree.values.max().item() != 1.0


def test_n_step_returns_of_torchrl_s_replay_are_discounted_for_all_their_steps():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    actor = modules.tanh_normal_actor(env, (16,))
    loss = TorchRLSACLoss(actor, [modules.q_value(env, 1, (16,)) for _ in range(2)], target_entropy=-1.0)
    loss.make_value_estimator(gamma=0.9)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), transform=MultiStepTransform(3, 0.9))
    update = updates.OffPolicyUpdate(
        loss, buffer, torch.optim.Adam(loss.parameters()), batch_size=8, learning_starts=8, compile="off"
    )
    update._batches.extend(collectors.VectorCollector(env, actor, frames_per_batch=64).rollout())
    data, index = next(update._batches.draw(1))
    batch = update._batches.gather(data, index)
    assert (batch["steps_to_next_obs"] == 3).any()


def test_targets_of_shared_parameters_lag_behind():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    shared = torch.nn.Linear(3, 8)
    actor = modules.tanh_normal_actor(env, encoder=shared)
    critic = TensorDictModule(TwoInputs(shared), in_keys=["observation", "action"], out_keys=["state_action_value"])
    loss = losses.SACLoss(actor, [critic], separate_losses=True)
    average = averaging(loss, tau=0.25)
    targets = loss.target_qvalue_network_params
    key = next(key for key in targets.keys(True, True) if targets[key].shape == shared.weight.shape)
    before = targets[key].clone()
    with torch.no_grad():
        shared.weight += 1.0
    assert average is not None
    average(torch.tensor(True))
    torch.testing.assert_close(targets[key], before + 0.25)


class TwoInputs(torch.nn.Module):
    """A critic on an encoder of the observation."""

    def __init__(self, encoder):
        super().__init__()
        self.encoder, self.value = encoder, torch.nn.Linear(9, 1)

    def forward(self, observation, action):
        return self.value(torch.cat([self.encoder(observation), action], -1))


def test_metrics_are_means_over_steps_with_and_without_the_actor():
    update, collector = agent(actor_delay=2, optimizer=lambda parameters, lr: torch.optim.SGD(parameters, lr=0.0))
    update._batches.extend(collector.rollout())
    update._batches.extend(collector.rollout())
    draws = [update.buffer.sample_index(32) for _ in range(4)]
    update.buffer.sample_index = lambda batch_size, batches=1: torch.cat(draws[:batches])
    torch.manual_seed(0)
    each = []
    for _ in range(4):
        each += [update.train(1)["loss_qvalue"]]
        draws.append(draws.pop(0))
    update.updates = 0
    torch.manual_seed(0)
    assert update.train(4)["loss_qvalue"] == pytest.approx(sum(each) / 4, rel=1e-5)
    assert len({round(value, 6) for value in each}) == 4


def test_priorities_under_another_key_and_a_loss_without_any():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    actor = modules.tanh_normal_actor(env, (16,))
    loss = losses.SACLoss(actor, modules.q_value(env, hidden=(16,)))
    loss.set_keys(priority="error")
    settings = {"batch_size": 32, "learning_starts": 64, "compile": "off"}
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=64).rollout()

    def prioritized(loss):
        buffer = data.ReplayBuffer(env, 100, sampler=data.Prioritized(), seed=0)
        return updates.OffPolicyUpdate(loss, buffer, torch.optim.Adam(loss.parameters()), **settings)

    update = prioritized(loss)
    assert update(rollout)["loss_qvalue"] > 0

    class Regression(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.net = torch.nn.Linear(3, 1)

        def forward(self, batch):
            error = self.net(batch["observation"]) - batch["next", "reward"]
            return TensorDict({"loss_reward": error.square().mean(), "rows": len(batch)})

    with pytest.raises(UserError, match="Regression writes no 'td_error' into the batch"):
        prioritized(Regression())(rollout)
    uniform = data.ReplayBuffer(env, 100, seed=0)
    loss = Regression()
    assert (
        updates.OffPolicyUpdate(loss, uniform, torch.optim.Adam(loss.parameters()), **settings)(rollout)["rows"] == 32
    )
    steps = data.ReplayBuffer(env, 100, n_steps=3, seed=0)
    with pytest.raises(UserError, match="give Regression one"):
        updates.OffPolicyUpdate(
            loss, steps, torch.optim.Adam(loss.parameters()), **{**settings, "learning_starts": 62}
        )(rollout)


class Bandit(gym.Env):
    observation_space = action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 1).astype("f4"), {}

    def step(self, action):
        return self.reset()[0], 1.0, True, False, {}


def trained_on_episodes_of_one_step(batch_size):
    env = envs.make(Bandit, num_envs=2, seed=1)
    actor = modules.tanh_normal_actor(env, (8,))
    loss = losses.SACLoss(actor, modules.q_value(env, 2, (8,)))
    update = updates.OffPolicyUpdate(
        loss, data.ReplayBuffer(env, 400), torch.optim.Adam(loss.parameters()), batch_size=batch_size,
        learning_starts=100, updates_per_step=0.25, compile="off",
    )  # fmt: skip
    for rollout in collectors.VectorCollector(env, actor, frames_per_batch=20, total_frames=400, compile="off"):
        update(rollout)
    return update


def test_short_episodes_delay_no_update():
    """Of episodes of one step the replay keeps an eighth of its capacity, less than learning_starts."""
    update = trained_on_episodes_of_one_step(batch_size=16)
    assert len(update.buffer) < 100 and update.updates == (400 - 80) / 4


def test_a_replay_that_never_has_a_batch_is_said():
    with pytest.raises(
        UserError, match=r"batch_size=64 is above the \d+ frames that the replay keeps of 100: .*final_rows"
    ):
        trained_on_episodes_of_one_step(batch_size=64)


@pytest.mark.parametrize("own", [True, False], ids=["pgkit's replay", "TorchRL's"])
def test_a_number_taken_outside_torch_is_not_kept_in_the_compiled_step(own):
    class Scaled(losses.SACLoss):
        def forward(self, batch):
            out = super().forward(batch)
            return out.set("loss_qvalue", out["loss_qvalue"] * float(batch["next", "reward"].numpy().std()))

    results = []
    for compile in ("on", "off"):
        torch.manual_seed(0)
        env = envs.make("Pendulum-v1")
        actor = modules.tanh_normal_actor(env, (8,))
        loss = Scaled(actor, modules.q_value(env, 2, (8,)))
        theirs = TensorDictReplayBuffer(storage=LazyTensorStorage(500), batch_size=32)
        update = updates.OffPolicyUpdate(
            loss, data.ReplayBuffer(env, 500, seed=0) if own else theirs, torch.optim.Adam(loss.parameters(), lr=0.0),
            batch_size=32, learning_starts=64, updates_per_step=0.05, compile="auto" if compile == "on" else "off",
        )  # fmt: skip
        collector = collectors.VectorCollector(env, actor, frames_per_batch=32)
        torch.manual_seed(1)
        results.append([update(collector.rollout()).get("loss_qvalue") for _ in range(5)][1:])
    assert results[0] == pytest.approx(results[1], rel=1e-4)


def test_torchrl_s_n_step_returns_of_several_environments_are_refused():
    env = envs.make("Pendulum-v1", num_envs=2)
    actor = modules.tanh_normal_actor(env, (8,))
    loss = losses.SACLoss(actor, modules.q_value(env, hidden=(8,)))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), transform=MultiStepTransform(3, 0.99))
    update = updates.OffPolicyUpdate(loss, buffer, torch.optim.Adam(loss.parameters()), batch_size=8, learning_starts=8)
    with pytest.raises(UserError, match="MultiStepTransform would add up rewards of 2 environments.*n_steps="):
        update(collectors.VectorCollector(env, actor, frames_per_batch=16, compile="off").rollout())


def test_targets_have_the_normalizer_s_present_statistics():
    env = envs.make("Pendulum-v1")
    normalizer = modules.ObsNormalizer(env)
    actor = modules.tanh_normal_actor(env, (8,), normalizer=normalizer)
    loss = losses.SACLoss(actor, modules.q_value(env, hidden=(8,), normalizer=normalizer))
    update = updates.OffPolicyUpdate(
        loss, data.ReplayBuffer(env, 100), torch.optim.Adam(loss.parameters()), batch_size=8, learning_starts=8,
        compile="off",
    )  # fmt: skip
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=16, compile="off").rollout()
    normalizer.update(rollout["observation"])
    seen = []
    forward = loss.forward

    def spied(batch):
        targets = loss.target_qvalue_network_params
        seen.extend(targets[key].clone() for key in targets.keys(True, True) if key[-1] == "mean")
        return forward(batch)

    loss.forward = spied
    update(rollout)
    assert len(seen) >= 16 and all(torch.equal(mean, normalizer.mean) for mean in seen)


def test_a_state_of_other_shapes_is_refused():
    env = envs.make("Pendulum-v1")
    made = []
    for head in (None, heads.Quantiles(5, drop=1)):
        loss = losses.SACLoss(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, hidden=(8,), head=head))
        made.append(updates.OffPolicyUpdate(loss, data.ReplayBuffer(env, 2000), torch.optim.Adam(loss.parameters())))
    with pytest.raises(ValueError, match=r"qvalue_network.* is \(2, 8, 1\) there and \(2, 8, 5\) here"):
        made[1].load_state_dict(made[0].state_dict())


class Conservative(losses.SACLoss):
    """A term more for the critics, and one for the actor."""

    def forward(self, tensordict):
        out = super().forward(tensordict)
        out["loss_conservative"] = self.q(tensordict, tensordict["action"], self.qvalue_network_params).mean()
        out["loss_prior"] = next(self.actor_network_params.parameters()).square().mean()
        return out


def test_a_term_that_trains_the_critics_alone_is_not_delayed_with_the_actor():
    env = envs.make("Pendulum-v1")
    actor, temperature = modules.tanh_normal_actor(env, (16,)), controllers.FixedTemperature(0.2)  # trains nothing
    loss = Conservative(actor, modules.q_value(env, hidden=(16,)), temperature=temperature)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    settings = {"batch_size": 32, "learning_starts": 64, "actor_delay": 2, "compile": "off"}
    update = updates.OffPolicyUpdate(loss, data.ReplayBuffer(env, 500), optimizer, **settings)
    update.buffer.extend(collectors.VectorCollector(env, actor, frames_per_batch=64).rollout())
    update.train(1)
    between = update.train(1)
    assert {name for name in between if name.startswith("loss_")} == {"loss_qvalue", "loss_conservative"}


def test_projection_follows_the_optimizer_and_comes_before_the_targets():
    seen = []
    update, collector = agent(project=lambda params: seen.append(len(params)), updates_per_step=0.25, actor_delay=2)
    update._average = lambda finite: seen.append("averaged")
    train(update, collector, rollouts=3)
    every, critics = len(update.optimizer.param_groups[0]["params"]), 2 * 2  # weight and bias of two layers
    assert update.updates == 16 and seen == [every, "averaged", critics, "averaged"] * 8


def test_copies_of_a_batch_give_each_row_one_priority():
    sampler = data.Prioritized(alpha=1.0, eps=0.0)
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 20, sampler=sampler)
    buffer.extend(hand_made(range(9), [1.0] * 8))
    copies = TensorDict({"td_error": torch.tensor([[1.0, 2.0], [4.0, 1.0]])}, [2, 2])  # as random_shift(copies=2) makes
    OwnBatches(buffer, torch.nn.Linear(1, 1), 2).write_back(buffer.data, torch.tensor([3, 5]), copies)
    assert sampler.tree.values[[3, 5]].tolist() == [4.0, 2.0]
