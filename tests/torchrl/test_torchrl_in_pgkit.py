"""Stock TorchRL losses, advantage estimators, collectors, environments and replay buffers in pgkit's updates."""

import copy
from functools import partial
from typing import Any

import pytest
import torch
from torchrl.data import (
    LazyTensorStorage,
    ListStorage,
    PrioritizedSampler,
    ReplayBuffer,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers.samplers import prioritized
from torchrl.envs import Compose, DoubleToFloat, GymEnv, MultiStepTransform, SerialEnv, TransformedEnv
from torchrl.envs.transforms import ObservationNorm, RewardScaling
from torchrl.objectives.value import GAE, TDLambdaEstimator, VTrace

from pgkit import collectors, losses, modules, updates
from tests.benchmarks.torchrl_losses import (
    OFF_POLICY,
    ON_POLICY,
    off_policy,
    off_policy_update,
    on_policy,
    on_policy_update,
    rollout,
)

SMALL = (16,)


def weights(update):
    return torch.cat([p.detach().flatten() for p in update.loss.parameters()])


def train(name: str, compile: str) -> tuple[Any, dict[str, float], torch.Tensor]:
    torch.manual_seed(0)
    if name in ON_POLICY:
        agent = on_policy(name, SMALL)
        update: Any = on_policy_update(agent, compile, minibatch_size=32, epochs=2)
        before = weights(update).clone()
        torch.manual_seed(1)
        return update, update(rollout(agent, 64)), before
    agent = off_policy(name, SMALL)
    update = off_policy_update(agent, compile, batch_size=32)
    update.optimizer.param_groups[0]["eps"] = 1e-3  # Adam makes a whole step of a gradient that is a rounding error
    before = weights(update).clone()
    update(rollout(agent, 128))
    torch.manual_seed(1)
    return update, update.train(4), before


@pytest.mark.parametrize("name", [*ON_POLICY, *OFF_POLICY])
def test_every_stock_loss_trains(name):
    update, metrics, before = train(name, "off")
    written = [key for key in metrics if key.startswith("loss")]
    assert written and all(metrics[key] == metrics[key] for key in written)
    assert (weights(update) - before).abs().max() > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", [*ON_POLICY, *OFF_POLICY])
def test_every_stock_loss_compiles(name, caplog):
    eager, expected, _ = train(name, "off")
    compiled, metrics, _ = train(name, "auto")
    assert "cannot be compiled and runs without" not in caplog.text
    assert metrics == pytest.approx(expected, rel=1e-2, abs=1e-2)
    for key, value in eager.loss.state_dict().items():  # buffers too: KLPENPPOLoss adapts one
        torch.testing.assert_close(compiled.loss.state_dict()[key], value, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("estimator", ["GAE", "VTrace", "TDLambdaEstimator", "compiled-free GAE"])
def test_torchrl_s_estimators_are_advantage_blocks(estimator):
    torch.manual_seed(0)
    agent = on_policy("ClipPPOLoss", SMALL)
    settings = {"gamma": 0.99, "value_network": agent.critic}
    block: Any = {
        "GAE": lambda: GAE(lmbda=0.95, **settings),
        "compiled-free GAE": lambda: GAE(lmbda=0.95, vectorized=False, **settings),
        "VTrace": lambda: VTrace(actor_network=agent.actor, **settings),
        "TDLambdaEstimator": lambda: TDLambdaEstimator(lmbda=0.95, **settings),
    }[estimator]()
    loss = losses.ClipPPOLoss(agent.actor, agent.critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    update = updates.OnPolicyUpdate(loss, block, optimizer, epochs=2, minibatch_size=32, compile="off")
    frames, before = rollout(agent, 64), weights(update).clone()
    metrics = update(frames)
    assert frames["advantage"].shape == frames["value_target"].shape == (4, 16, 1)
    assert metrics["loss_critic"] > 0 and (weights(update) - before).abs().max() > 1e-3


def gym_env(env_id: str, num_envs: int = 2):
    env = SerialEnv(num_envs, lambda: GymEnv(env_id, categorical_action_encoding=True))
    return TransformedEnv(
        env, Compose(DoubleToFloat(), RewardScaling(0.0, 0.5), ObservationNorm(0.0, 2.0, ["observation"]))
    )


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
def test_a_transformed_gym_env_feeds_pgkit_s_modules_and_update(env_id):
    torch.manual_seed(0)
    env = gym_env(env_id)
    build = modules.categorical_actor if env_id == "CartPole-v1" else modules.gaussian_actor
    actor, critic = build(env, SMALL), modules.state_value(env, SMALL)
    loss = losses.ClipPPOLoss(actor, critic)
    update = updates.OnPolicyUpdate(
        loss, GAE(gamma=0.99, lmbda=0.95, value_network=critic), torch.optim.Adam(loss.parameters()), minibatch_size=16,
        epochs=1, compile="off",
    )  # fmt: skip
    collector = collectors.TorchRLCollector(env, actor, frames_per_batch=32, total_frames=64)
    before = weights(update).clone()
    for frames in collector:
        assert frames.batch_size == (2, 16) and update(frames)["loss_objective"] is not None
    assert collector.frames == 64 and not torch.equal(weights(update), before)
    collector.shutdown()


BUFFERS: dict[str, Any] = {
    "ReplayBuffer": lambda: ReplayBuffer(storage=LazyTensorStorage(500), batch_size=32),
    "TensorDictReplayBuffer": lambda: TensorDictReplayBuffer(storage=LazyTensorStorage(500), batch_size=32),
    "ListStorage": lambda: ReplayBuffer(storage=ListStorage(500), batch_size=32, collate_fn=torch.stack),
    "n-step": lambda: TensorDictReplayBuffer(
        storage=LazyTensorStorage(500), batch_size=32, transform=MultiStepTransform(n_steps=3, gamma=0.99)
    ),
}


@pytest.mark.parametrize("name", ["SACLoss", "DQNLoss"])
@pytest.mark.parametrize("buffer", BUFFERS)
def test_every_replay_buffer_class_feeds_the_update(buffer, name):
    torch.manual_seed(0)
    agent = off_policy(name, SMALL)
    update = off_policy_update(agent, "off", BUFFERS[buffer](), batch_size=32)
    before = copy.deepcopy(weights(update))
    frames = rollout(agent, 128)
    update(frames[:1] if buffer == "n-step" else frames)  # its transform knows nothing of several environments
    metrics = update.train(3)
    assert metrics["grad_norm"] > 0 and not torch.equal(before, weights(update))


class PythonTree:
    """Stands in for TorchRL's C++ trees, which do not load under torch 2.13: the same calls, over an array."""

    def __init__(self, reduce: Any, empty: float, size: int) -> None:
        self.values, self.reduce = torch.full((size,), empty), reduce

    def __getitem__(self, index: Any) -> Any:
        return self.values[index]

    def __setitem__(self, index: Any, value: Any) -> None:
        self.values[index] = torch.as_tensor(value, dtype=torch.float32).expand_as(self.values[index])

    def query(self, start: int, end: int) -> float:
        return float(self.reduce(self.values[start:end]))

    def scan_lower_bound(self, mass: Any) -> torch.Tensor:
        return torch.searchsorted(self.values.cumsum(0), torch.as_tensor(mass, dtype=torch.float32), right=True)


PRIORITIZED: dict[str, Any] = {
    "TensorDictPrioritizedReplayBuffer": lambda: TensorDictPrioritizedReplayBuffer(
        alpha=0.7, beta=0.5, storage=LazyTensorStorage(500), batch_size=32
    ),
    "PrioritizedSampler": lambda: TensorDictReplayBuffer(
        storage=LazyTensorStorage(500), sampler=PrioritizedSampler(500, 0.7, 0.5), batch_size=32
    ),
}


@pytest.mark.parametrize("name", ["SACLoss", "DQNLoss"])
@pytest.mark.parametrize("buffer", PRIORITIZED)
def test_priorities_go_back_to_torchrl_s_prioritized_buffers(buffer, name, monkeypatch):
    if prioritized.SumSegmentTreeFp32 is None:
        for size in ("Fp32", "Fp64"):
            monkeypatch.setattr(prioritized, f"SumSegmentTree{size}", partial(PythonTree, torch.sum, 0.0))
            monkeypatch.setattr(prioritized, f"MinSegmentTree{size}", partial(PythonTree, torch.min, float("inf")))
    torch.manual_seed(0)
    agent, made = off_policy(name, SMALL), PRIORITIZED[buffer]()
    update = off_policy_update(agent, "off", made, batch_size=32)
    update(rollout(agent, 128))
    assert made.sampler._sum_tree[torch.arange(128)].unique().numel() == 1
    update.train(3)
    priorities = made.sampler._sum_tree[torch.arange(128)]
    assert priorities.unique().numel() > 30
    errors, rows = update._batches._batch["td_error"], update._batches._sample["index"]
    expected = (errors.abs() + made.sampler._eps) ** 0.7
    alone = [i for i in range(32) if (rows == rows[i]).sum() == 1]
    torch.testing.assert_close(priorities[rows][alone], expected[alone])
