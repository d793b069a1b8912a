"""The bare step of every loss on a device that is not the CPU: nothing is made elsewhere, no value is read back.

A fake CUDA device cannot take gradients in a torch without CUDA, so this is the meta device, under fake tensors: these
refuse to mix devices, which meta tensors alone do not, and to give a value.
"""

import pytest
import torch
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorDeviceMismatchError, FakeTensorMode

from pgkit import data, envs, modules
from pgkit.updates import GradientStep
from pgkit.updates.batches import OwnBatches
from pgkit.updates.step import grads_of, metrics_of
from tests.data.test_replay import hand_made
from tests.losses.test_contract import ALGORITHMS, batch, make

BUILDERS = ("gaussian_actor", "deterministic_actor", "tanh_normal_actor", "categorical_actor", "state_value")
BUILDERS += ("q_value", "discrete_q_value")


@pytest.fixture(autouse=True)
def networks_elsewhere(monkeypatch):
    for name in BUILDERS:
        build = getattr(modules, name)
        monkeypatch.setattr(modules, name, lambda *args, build=build, **kwargs: build(*args, **kwargs).to("meta"))
    monkeypatch.setattr(torch.Tensor, "is_set_to", lambda x, other: x is other)  # meta tensors cannot say


def bare_step(name, spoil=lambda batch: None):
    """Runs a step as it is recorded."""
    loss, data = make(name), batch(name).to("meta")
    assert {x.device.type for x in (*loss.parameters(), *loss.buffers())} == {"meta"}, name
    optimizer = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad])
    params = optimizer.param_groups[0]["params"]
    names = [key for key in loss.out_keys if key.startswith("loss_")]

    def gradients(data, index):
        rows = data[index]
        spoil(rows)
        out = loss(rows)
        grads = grads_of(out, params)
        return metrics_of(out, names, like=grads[0]), grads

    step = GradientStep(gradients, optimizer, names, watch={"the loss": loss}, max_grad_norm=0.5, mode="on")
    with FakeTensorMode(allow_non_fake_inputs=True), torch.compiler._compile_session_context():
        index = torch.arange(8, device="meta")
        (metrics,) = step.native[0].function(data, index)
    assert metrics.device.type == "meta" and metrics.shape == (len(names) + 2,)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_step_stays_on_its_device_and_reads_no_value_back(name):
    bare_step(name)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_a_replay_on_the_cpu_gives_batches_where_the_loss_is_and_takes_errors_from_there(n_steps):
    env = envs.make("Pendulum-v1")
    buffer = data.ReplayBuffer(env, 100, n_steps=n_steps, sampler=data.Prioritized())
    buffer.extend(hand_made(range(33), [1.0] * 32))
    rows, index = OwnBatches(buffer, make("SACLoss"), 8), buffer.sample_index(8)[0]
    with FakeTensorMode(allow_non_fake_inputs=True):
        batch = rows.gather(buffer.data, index)
        assert {x.device.type for x in batch.values(True, True)} == {"meta"}
        rows.write_back(buffer.data, index, batch.set("td_error", torch.ones(8, device="meta")))


def test_what_would_be_wrong_shows():
    def elsewhere(rows):
        rows["next", "reward"] = rows["next", "reward"] + torch.ones(8, 1)

    def reads(rows):
        rows["next", "reward"] = rows["next", "reward"] * float(rows["next", "reward"].max())

    with pytest.raises(FakeTensorDeviceMismatchError):
        bare_step("SACLoss", elsewhere)
    with pytest.raises(DataDependentOutputException):
        bare_step("SACLoss", reads)
