import copy
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import ClipPPOLoss as TorchRLClipPPOLoss
from torchrl.objectives.value import GAE as TorchRLGAE

from pgkit import advantages, controllers, envs, losses, modules, updates
from pgkit.errors import UserError
from pgkit.updates.on_policy import CompiledAdvantage


def make_agent(seed=0, dtype=torch.float32, loss_class=losses.ClipPPOLoss, optimizer=torch.optim.Adam, **kwargs):
    torch.manual_seed(seed)
    env = envs.make("Pendulum-v1")
    actor, critic = modules.gaussian_actor(env).to(dtype), modules.state_value(env).to(dtype)
    loss = loss_class(actor, critic, entropy_coeff=0.01).to(dtype)
    settings = {"epochs": 2, "minibatch_size": 32, "compile": "off", "seed": 1} | kwargs
    parameters = optimizer([*actor.parameters(), *critic.parameters()], lr=1e-3)
    gae = settings.pop("advantage", advantages.GAE(critic).to(dtype))
    return updates.OnPolicyUpdate(loss, gae, parameters, **settings)


def make_rollout(seed=0, dtype=torch.float32, rows=(2, 64)):
    g = torch.Generator().manual_seed(seed)

    def draw(*size):
        return torch.randn(*rows, *size, generator=g, dtype=dtype)

    done = draw(1) > 2
    observation, final = draw(3), draw(3)
    after = torch.where(done, final, torch.cat([observation[:, 1:], final[:, -1:]], 1))
    next_td = {"observation": after, "reward": draw(1), "done": done, "terminated": done}
    data = {"observation": observation, "action": draw(1), "action_log_prob": draw() * 0.1 - 1, "next": next_td}
    return TensorDict(data, rows)


def parameters(update):
    return torch.cat([p.detach().flatten() for p in update.loss.parameters()])


def test_compiling_leaves_no_trace():
    update = make_agent(compile="on", epochs=1, minibatch_size=None)
    twin = make_agent(compile="off", epochs=1, minibatch_size=None)
    state = torch.get_rng_state()
    assert update(make_rollout()) == pytest.approx(twin(make_rollout()), rel=1e-4, abs=1e-5)
    assert torch.equal(torch.get_rng_state(), state)
    torch.testing.assert_close(parameters(update), parameters(twin))
    for a, b in zip(update.optimizer.state.values(), twin.optimizer.state.values(), strict=True):
        assert a["step"] == b["step"] == 1


@pytest.mark.parametrize(
    "optimizer",
    [
        partial(torch.optim.SGD, momentum=0.9, nesterov=True, weight_decay=0.1),
        partial(torch.optim.RMSprop, momentum=0.9, centered=True, weight_decay=0.1, maximize=True),
        torch.optim.AdamW,
        torch.optim.Adagrad,
    ],
)
def test_every_optimizer_compiles(optimizer):
    a, b = (make_agent(compile=mode, optimizer=optimizer, epochs=1) for mode in ("on", "off"))
    for i in range(3):
        for update in (a, b):
            update.optimizer.param_groups[0]["lr"] = 1e-3 * (i + 1)
            update(make_rollout(i))
    torch.testing.assert_close(parameters(a), parameters(b), rtol=1e-4, atol=1e-5)


def test_several_optimizers_together_are_part_of_the_step(monkeypatch):
    def two(parameters, lr):
        return updates.Together(
            torch.optim.Adam(parameters[:5], lr=lr), torch.optim.SGD(parameters[5:], lr=0.1, momentum=0.9)
        )

    update, twin = make_agent(compile="on", optimizer=two, epochs=1), make_agent(optimizer=two, epochs=1)
    monkeypatch.setattr(update.optimizer, "step", lambda: pytest.fail("stepped outside the graph"))
    for i in range(2):
        update.optimizer.param_groups[1]["lr"] = twin.optimizer.param_groups[1]["lr"] = 0.1 * (i + 1)
        assert update(make_rollout(i)) == pytest.approx(twin(make_rollout(i)), rel=1e-4, abs=1e-5)
        torch.testing.assert_close(parameters(update), parameters(twin), rtol=1e-4, atol=1e-5)


def test_a_compiled_advantage_follows_weights_settings_and_layouts():
    update = make_agent(compile="on", epochs=1, minibatch_size=None)
    update(make_rollout())
    block: Any = update.advantage
    assert update._plan is not None
    estimate = update._plan.block
    assert isinstance(estimate, CompiledAdvantage) and estimate.native.rung == "recorded and compiled"
    other = make_rollout(3, rows=(64, 2)).transpose(0, 1)  # the same shape, other strides
    for rollout in (make_rollout(1), make_rollout(2), other):
        with torch.no_grad():
            for parameter in block.critic.parameters():
                parameter.add_(0.1)
        block.gamma.mul_(0.9)
        expected, got = block(rollout.clone()), estimate(rollout.clone(recurse=False))
        for key in block.out_keys:
            torch.testing.assert_close(got[key], expected[key])


def test_an_advantage_that_changes_its_buffers_keeps_doing_so():
    class Counting(advantages.GAE):
        def estimate(self, value, next_value, rollout):
            self.gamma.mul_(0.9)
            return super().estimate(value, next_value, rollout)

    block = Counting(modules.state_value(envs.make("Pendulum-v1")))
    estimate, twin = CompiledAdvantage(block, "on"), copy.deepcopy(block)
    for i in range(3):
        expected, got = twin(make_rollout(i)), estimate(make_rollout(i))
        torch.testing.assert_close(got["advantage"], expected["advantage"])
        torch.testing.assert_close(block.gamma, twin.gamma)


def test_a_block_that_is_too_long_to_compile_is_recorded_or_refused(caplog):
    class Loop(advantages.GAE):
        def estimate(self, value, next_value, rollout):
            total = torch.zeros_like(value[..., 0, :])
            for t in range(value.shape[-2]):
                total = total * self.gamma + value[..., t, :] * next_value[..., t, :]
            return super().estimate(value + total.unsqueeze(-2), next_value, rollout)

    block = Loop(modules.state_value(envs.make("Pendulum-v1")))
    estimate = CompiledAdvantage(block, "auto")
    torch.testing.assert_close(estimate(make_rollout())["advantage"], block(make_rollout())["advantage"])
    assert estimate.native.rung == "recorded, not compiled" and "too many to compile soon" in caplog.text
    with pytest.raises(UserError, match="the advantage block cannot be compiled .*too many to compile soon"):
        CompiledAdvantage(block, "on")(make_rollout())


def test_compiled_step_follows_normalizers_coefficients_and_learning_rate():
    def agent(mode):
        torch.manual_seed(0)
        env = envs.make("Pendulum-v1")
        normalizer = modules.ObsNormalizer(env)
        actor, critic = (f(env, normalizer=normalizer) for f in (modules.gaussian_actor, modules.state_value))
        update = updates.OnPolicyUpdate(
            losses.ClipPPOLoss(actor, critic, entropy_coeff=0.1),
            advantages.GAE(critic),
            torch.optim.Adam([*actor.parameters(), *critic.parameters()]),
            compile=mode,
            epochs=1,
            seed=0,
        )
        out = []
        for i in range(3):
            out.append(update(make_rollout(i)))
            normalizer.update(make_rollout(i)["observation"] * 3 + 1)
            update.loss.entropy_coeff = 0.1 * i
            update.loss.clip_epsilon = 0.01
            update.optimizer.param_groups[0]["lr"] = 1e-2
        return out

    for a, b in zip(agent("on"), agent("off"), strict=True):
        assert a == pytest.approx(b, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("loss_class", [losses.ClipPPOLoss, TorchRLClipPPOLoss])
def test_eager_and_compiled_agree(loss_class):
    eager, compiled = (make_agent(dtype=torch.float64, loss_class=loss_class, compile=mode) for mode in ("off", "on"))
    for i in range(20):
        a, b = (update(make_rollout(i, torch.float64)) for update in (eager, compiled))
        assert a.keys() == b.keys()
        assert a == pytest.approx(b, rel=1e-5, abs=1e-7)
    torch.testing.assert_close(parameters(eager), parameters(compiled), rtol=0, atol=1e-5)
    assert compiled.compile_seconds > 0 == eager.compile_seconds
    assert compiled._plan is not None and compiled._plan.native[0].rung == "recorded and compiled"


def test_two_compiled_agents_in_one_process_do_not_mix():
    pair = [make_agent(seed, torch.float64, compile="on") for seed in (0, 1)]
    alone = make_agent(1, torch.float64, compile="off")
    start = [parameters(update).clone() for update in pair]
    for i in range(3):
        for update in pair:
            update(make_rollout(i, torch.float64))
        alone(make_rollout(i, torch.float64))
    torch.testing.assert_close(parameters(pair[1]), parameters(alone), rtol=0, atol=1e-6)
    assert not torch.equal(parameters(pair[0]) - start[0], parameters(pair[1]) - start[1])


@pytest.mark.parametrize(
    "optimizer",
    [
        torch.optim.Adam,
        lambda p, lr: torch.optim.AdamW(p, lr=lr, weight_decay=0.1, amsgrad=True),
        lambda p, lr: torch.optim.SGD(p, lr=lr, momentum=0.9, nesterov=True),
        lambda p, lr: torch.optim.SGD(p, lr=lr, momentum=0.9, dampening=0.5),  # outside too
        lambda p, lr: torch.optim.RMSprop(p, lr=lr, momentum=0.5, centered=True),
        torch.optim.Adagrad,  # has no functional form here: steps outside the graph
        lambda p, lr: torch.optim.Adam([{"params": p[:3], "lr": 1e-2}, {"params": p[3:]}], lr=lr),
    ],
)
def test_optimizer_steps_as_torch_would(optimizer):
    update = make_agent(optimizer=optimizer, dtype=torch.float64, epochs=1, minibatch_size=None, max_grad_norm=0.5)
    twin = make_agent(optimizer=optimizer, dtype=torch.float64)
    for i in range(3):
        rollout = make_rollout(i, torch.float64)
        update(rollout)
        estimate: Any = twin.advantage
        batch = estimate(make_rollout(i, torch.float64)).reshape(-1)
        order = torch.randperm(128, generator=twin.generator)
        out = twin.loss(batch[order])
        twin.optimizer.zero_grad()
        (out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]).backward()
        torch.nn.utils.clip_grad_norm_(twin.loss.parameters(), 0.5)
        twin.optimizer.step()
    torch.testing.assert_close(parameters(update), parameters(twin), rtol=1e-9, atol=1e-9)
    mine, theirs = update.optimizer.state_dict()["state"], twin.optimizer.state_dict()["state"]
    for i in theirs:
        for key, value in theirs[i].items():
            torch.testing.assert_close(torch.as_tensor(mine[i][key]).double(), torch.as_tensor(value).double())


def test_a_shorter_last_minibatch_counts_like_any_other():
    update = make_agent(minibatch_size=48, epochs=1)  # 128 rows: 48 + 48 + 32
    sizes, loss = [], update.loss.forward
    update.loss.forward = lambda batch: (sizes.append(len(batch)), loss(batch))[1]
    update(make_rollout())
    looks = [48, 48]  # the assembly check, and which buffers the loss writes to
    assert sizes == [*looks, 48, 48, 32]


def test_every_row_is_seen_once_an_epoch_and_in_another_order():
    update, seen = make_agent(epochs=2), []
    loss = update.loss.forward
    update.loss.forward = lambda batch: (seen.append(batch["observation"]), loss(batch))[1]
    rollout = make_rollout()
    update(rollout)
    epochs = torch.cat(seen[2:]).reshape(2, 128, 3)  # after the two looks
    expected = rollout["observation"].reshape(-1, 3).sort(0)[0]
    assert torch.equal(epochs[0].sort(0)[0], expected) and torch.equal(epochs[1].sort(0)[0], expected)
    assert not torch.equal(epochs[0], epochs[1])


@pytest.mark.parametrize("compile", ["off", "on"])
def test_accumulated_minibatches_are_one_larger_one(compile):
    """Weighted by their rows: 128 rows are 48 + 48 + 32, or (24 + 24) + (24 + 24) + (24 + 8)."""
    loss = partial(losses.ClipPPOLoss, normalize_advantage=False)
    settings = {"dtype": torch.float64, "loss_class": loss}
    update = make_agent(minibatch_size=24, accumulate=2, compile=compile, **settings)
    twin = make_agent(minibatch_size=48, **settings)
    for i in range(2):
        got, expected = (agent(make_rollout(i, torch.float64)) for agent in (update, twin))
        assert {name: got[name] for name in ("loss_objective", "grad_norm", "epochs")} == pytest.approx(
            {name: expected[name] for name in ("loss_objective", "grad_norm", "epochs")}, rel=1e-6
        )
    torch.testing.assert_close(parameters(update), parameters(twin), rtol=0, atol=1e-6)
    assert update._plan is not None
    assert [native.seconds > 0 for native in update._plan.native] == [compile == "on"] * 2


def test_something_between_gradient_and_optimizer():
    settings = {"optimizer": torch.optim.SGD, "dtype": torch.float64, "max_grad_norm": None, "epochs": 1}
    doubled, twin = make_agent(**settings), make_agent(**settings)
    doubled.between = lambda grads: [2 * grad for grad in grads]
    twin.optimizer.param_groups[0]["lr"] *= 2
    for update in (doubled, twin):
        update(make_rollout(0, torch.float64))
    torch.testing.assert_close(parameters(doubled), parameters(twin), rtol=1e-12, atol=1e-12)


def test_an_augmentation_is_part_of_the_step_and_draws_anew():
    class Noise(torch.nn.Module):
        scale = 0.5

        def forward(self, batch):
            return batch.set("observation", batch["observation"] + self.scale * torch.randn_like(batch["observation"]))

    results = []
    for compile in ("off", "on"):
        update = make_agent(augment=Noise(), compile=compile, dtype=torch.float64, epochs=1)
        torch.manual_seed(5)
        metrics = [update(make_rollout(0, torch.float64)) for _ in range(2)]
        results.append((metrics, parameters(update)))
    (eager, expected), (compiled, got) = results
    assert all(a == pytest.approx(b, rel=1e-5, abs=1e-7) for a, b in zip(eager, compiled, strict=True))
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-5)
    plain = make_agent(dtype=torch.float64, epochs=1)
    assert plain(make_rollout(0, torch.float64))["loss_critic"] != pytest.approx(eager[0]["loss_critic"], rel=1e-3)


def test_target_kl_stops_after_the_epoch():
    assert make_agent(epochs=8)(make_rollout())["epochs"] == 8
    metrics = make_agent(epochs=8, target_kl=1e-4)(make_rollout())
    assert metrics["epochs"] < 8 and metrics["approx_kl"] > 1e-4


def test_schedules_reach_optimizer_and_loss():
    schedules = {"lr": controllers.linear(1.0, 0.0), "entropy_coeff": controllers.linear(0.2, 0.1)}
    update = make_agent(schedules=schedules, total_frames=256)
    start = parameters(update).clone()
    update(make_rollout())
    assert update.optimizer.param_groups[0]["lr"] == 1.0
    assert (parameters(update) - start).abs().max() > 0.1
    metrics = update(make_rollout())
    assert metrics["learning_rate"] == 0.5 and update.loss.entropy_coeff.item() == pytest.approx(0.15)
    before = parameters(update).clone()
    update(make_rollout())  # the end: a learning rate of zero
    assert torch.equal(parameters(update), before)
    with pytest.raises(UserError, match="give total_frames too"):
        make_agent(schedules=schedules)


def test_recompute_advantage_uses_the_new_critic():
    update, calls = make_agent(epochs=3, recompute_advantage=True), []
    block: Any = update.advantage
    gae = block.forward
    block.forward = lambda rollout: (calls.append(gae(rollout)["advantage"].clone()), rollout)[1]
    update(make_rollout())
    assert len(calls) == 3 and not torch.equal(calls[0], calls[1])


def test_resume_is_exact():
    update = make_agent()
    update(make_rollout(0))
    state = torch.utils._pytree.tree_map(lambda x: x.clone() if torch.is_tensor(x) else x, update.state_dict())
    expected = update(make_rollout(1))
    again = make_agent(seed=9, optimizer=torch.optim.Adam)
    again.load_state_dict(state)
    assert again(make_rollout(1)) == expected
    assert torch.equal(parameters(again), parameters(update))


def test_torchrl_parts_unmodified():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    actor, critic = modules.gaussian_actor(env), modules.state_value(env)
    update = updates.OnPolicyUpdate(
        loss=TorchRLClipPPOLoss(actor, critic),
        advantage=TorchRLGAE(gamma=0.99, lmbda=0.95, value_network=critic),
        optimizer=torch.optim.Adam([*actor.parameters(), *critic.parameters()]),
        normalize_advantage=True,
        compile="off",
    )
    assert update(make_rollout())["loss_critic"] > 0


def test_advantage_is_normalized_by_one_owner_only():
    with pytest.raises(UserError, match="normalizes the advantage already"):
        make_agent(normalize_advantage=True)


def test_a_last_minibatch_of_one_row_is_no_nan():
    loss = partial(losses.ClipPPOLoss, normalize_advantage=False)
    update = make_agent(loss_class=loss, minibatch_size=32, normalize_advantage=True, epochs=1)
    metrics = update(make_rollout(rows=(1, 33)))
    assert metrics["loss_objective"] == metrics["loss_objective"]
    assert all(p.isfinite().all() for p in update.loss.parameters())


def test_rows_that_a_mask_leaves_out_are_in_no_average_and_are_no_frames():
    results = []
    for spoilt in (0.0, 1e6):
        loss = partial(losses.ClipPPOLoss, normalize_advantage=False)
        update, rollout = make_agent(loss_class=loss, normalize_advantage=True, advantage=None), make_rollout()
        mask = torch.arange(64).expand(2, 64) % 4 > 0
        rollout["advantage"] = torch.where(mask.unsqueeze(-1), rollout["next", "reward"], spoilt)
        rollout["value_target"], rollout["collector", "mask"] = rollout["next", "reward"], mask
        update(rollout)
        assert update.frames == 96
        results.append(parameters(update))
    assert torch.equal(*results)


def test_a_schedule_of_what_the_loss_does_not_have_is_refused():
    with pytest.raises(UserError, match="'clip_epsilom'.*lr, clip_epsilon, critic_coeff, entropy_coeff"):
        make_agent(schedules={"clip_epsilom": lambda progress: 0.1}, total_frames=100)


@pytest.mark.parametrize(("network", "key"), [("actor", "foo"), ("critic", "v")])
def test_a_key_that_nobody_writes_is_explained(network, key):
    update = make_agent()
    update.loss.set_keys(**({"action": key} if network == "actor" else {"value": key}))
    with pytest.raises(UserError, match=f"'?{key}'?"):
        update(make_rollout())


def test_sizes_of_numpy_are_whole_numbers_too():
    update = make_agent(epochs=1, minibatch_size=np.int64(32))
    assert update(make_rollout()) == pytest.approx(make_agent(epochs=1, minibatch_size=32)(make_rollout()))


@pytest.mark.parametrize("compile", ["off", "on"])
def test_a_reset_of_the_optimizer_s_state_begins_again(compile):
    update = make_agent(compile=compile, epochs=1)
    fresh = make_agent(compile=compile, epochs=1)
    update(make_rollout(0))
    fresh.loss.load_state_dict(update.loss.state_dict())
    fresh.generator.set_state(update.generator.get_state())
    update.optimizer.state.clear()
    assert update(make_rollout(1)) == pytest.approx(fresh(make_rollout(1)), rel=1e-5, abs=1e-6)
    torch.testing.assert_close(parameters(update), parameters(fresh))
    for a, b in zip(update.optimizer.state.values(), fresh.optimizer.state.values(), strict=True):
        assert a["step"] == b["step"] == 4
        torch.testing.assert_close(a["exp_avg"], b["exp_avg"])


def test_freezing_after_the_first_update_is_refused():
    update = make_agent()
    update(make_rollout())
    next(iter(update.optimizer.param_groups[0]["params"])).requires_grad_(False)
    with pytest.raises(UserError, match="was frozen after the first step"):
        update(make_rollout())


class Cloning(losses.PolicyLoss):
    """Behaviour cloning."""

    def _reads(self):
        return [*self.actor_network.in_keys, "action"]

    def forward(self, tensordict):
        log_prob = self.distribution(tensordict).log_prob(tensordict["action"])
        return TensorDict({"loss_cloning": -log_prob.mean()})


def test_a_loss_of_the_policy_that_reads_no_advantage_needs_none():
    env = envs.make("Pendulum-v1")
    loss = Cloning(modules.gaussian_actor(env))
    update = updates.OnPolicyUpdate(loss, None, torch.optim.Adam(loss.parameters(), lr=1e-2), epochs=4, compile="off")
    rollout = make_rollout()
    assert update(rollout)["loss_cloning"] > update(rollout)["loss_cloning"]
