"""A step whose gradient is not finite changes nothing, and is counted."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from pgkit import collectors, data, envs, losses, modules, updates
from pgkit.updates.minibatches import means
from pgkit.updates.step import GradientStep, grads_of, metrics_of
from tests.losses.test_contract import batch, make

BAD = {"nan": lambda x: x * torch.nan, "inf": lambda x: x + torch.inf, "overflow": lambda x: x.sign() * 1e30}


def everything(*parts):
    """Every tensor of some modules and optimizers."""
    return [x.clone() for part in parts for x in _tensors(part.state_dict())]


def _tensors(state):
    if isinstance(state, torch.Tensor):
        return [state]
    return [x for value in (state.values() if isinstance(state, dict) else ()) for x in _tensors(value)]


def gradients_of(loss, params, names):
    def gradients(data, index):
        out = loss(data[index])
        grads = grads_of(out, params)
        return metrics_of(out, names, grads[0]), grads

    return gradients


class CountingLoss(nn.Module):
    """It keeps statistics of what it has seen, moved in the forward pass."""

    def __init__(self):
        super().__init__()
        self.net = nn.Linear(2, 1)
        self.register_buffer("seen", torch.zeros(2))

    def forward(self, batch):
        self.seen.add_(batch["x"].mean(0))
        return TensorDict({"loss_x": (self.net(batch["x"] - self.seen) ** 2).mean()})


@pytest.mark.parametrize("mode", ["off", "record"])
@pytest.mark.parametrize("optimizer", [torch.optim.Adam, torch.optim.RMSprop, torch.optim.Adagrad])
@pytest.mark.parametrize("apart", [False, True])
def test_weights_moments_and_statistics_stay(mode, optimizer, apart):
    torch.manual_seed(0)
    loss = CountingLoss()
    optimizer = optimizer(loss.parameters(), lr=0.1)
    gradients = gradients_of(loss, list(loss.parameters()), ["loss_x"])
    step = GradientStep(gradients, optimizer, ["loss_x"], watch={"the loss": loss}, apart=apart, mode=mode)
    rows, index = TensorDict({"x": torch.randn(8, 2)}, [8]), torch.arange(4)
    assert step(rows, index)[-1] == 0
    before = everything(loss, optimizer)
    for bad in BAD.values():
        result = step(rows.apply(bad), index)
        assert result[-1] == 1 and all(map(torch.equal, everything(loss, optimizer), before))
    assert step(rows, index)[-1] == 0
    after = everything(loss, optimizer)
    assert not torch.equal(after[0], before[0]) and not all(map(torch.equal, after, before))


def test_one_bad_minibatch_of_several_skips_the_step():
    torch.manual_seed(0)
    loss = CountingLoss()
    optimizer = torch.optim.Adam(loss.parameters())
    gradients = gradients_of(loss, list(loss.parameters()), ["loss_x"])
    step = GradientStep(gradients, optimizer, ["loss_x"], watch={"the loss": loss}, apart=True)
    rows = TensorDict({"x": torch.randn(8, 2)}, [8])
    rows["x"][5] = torch.nan
    before = everything(loss)
    assert step.bind(rows, torch.arange(4))(torch.arange(4), torch.arange(4, 8))[-1] == 1
    assert all(map(torch.equal, everything(loss), before))


def agent(sampler=None):
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=2, seed=1)
    actor, critics = modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 2, (8,))
    loss = losses.SACLoss(actor, critics)
    buffer = data.ReplayBuffer(env, 256, sampler=sampler)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    update = updates.OffPolicyUpdate(loss, buffer, optimizer, batch_size=16, learning_starts=16, compile="off")
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=64, compile="off").rollout()
    return update, rollout


def test_targets_and_priorities_stay():
    update, rollout = agent(data.Prioritized())
    assert update(rollout)["skipped"] == 0
    rewards = update.buffer.data["frames", "reward"]
    kept = rewards.clone()
    rewards.fill_(torch.inf)
    before = everything(update.loss, update.optimizer, update.buffer.sampler)
    assert update.train(3)["skipped"] == 1
    assert all(map(torch.equal, everything(update.loss, update.optimizer, update.buffer.sampler), before))
    rewards.copy_(kept)
    assert update.train(1)["skipped"] == 0
    assert not all(map(torch.equal, everything(update.buffer.sampler), before[-3:]))


@pytest.mark.parametrize("mode", ["off", "record"])
def test_the_statistics_of_a_batch_norm_stay(mode):
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    critics = modules.q_value(env, 2, (8,), body=modules.batch_renorm_mlp)
    loss, rows = losses.CrossQLoss(modules.tanh_normal_actor(env, (8,)), critics), batch("CrossQLoss")
    optimizer = torch.optim.Adam(loss.parameters())
    gradients = gradients_of(loss, optimizer.param_groups[0]["params"], ["loss_qvalue"])
    step = GradientStep(gradients, optimizer, ["loss_qvalue"], watch={"the loss": loss}, mode=mode)
    bad = rows.clone()
    bad["next", "reward"][0] = torch.nan
    assert step(rows, torch.arange(8))[-1] == 0
    before = everything(loss, optimizer)
    assert step(bad, torch.arange(8))[-1] == 1 and all(map(torch.equal, everything(loss, optimizer), before))
    assert step(rows, torch.arange(8))[-1] == 0
    assert not all(map(torch.equal, everything(loss, optimizer), before))


def test_an_adapting_coefficient_stays():
    loss, rows = make("KLPENPPOLoss"), batch("KLPENPPOLoss")
    optimizer = torch.optim.Adam(loss.parameters())
    params = optimizer.param_groups[0]["params"]
    step = GradientStep(
        gradients_of(loss, params, ["loss_objective"]), optimizer, ["loss_objective"], watch={"the loss": loss}
    )
    before = everything(loss)
    rows["advantage"][:] = torch.nan
    assert step(rows, torch.arange(8))[-1] == 1 and all(map(torch.equal, everything(loss), before))
    rows["advantage"][:] = 1.0
    assert step(rows, torch.arange(8))[-1] == 0 and not torch.equal(loss.beta, torch.ones_like(loss.beta))


def test_metrics_are_means_over_the_steps_that_were_taken():
    # of 3 steps with losses 1, nan, 3 the second was skipped: (1 + 3) / 2 = 2, and a third was
    results = [torch.tensor([1.0, 0.0]), torch.tensor([torch.nan, 1.0]), torch.tensor([3.0, 0.0])]
    assert means(["loss", "skipped"], results) == {"loss": 2.0, "skipped": pytest.approx(1 / 3)}
    assert means(["loss", "skipped"], [torch.tensor([torch.inf, 1.0])]) == {"loss": torch.inf, "skipped": 1.0}
