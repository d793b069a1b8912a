"""PPO and SAC assembled from TorchRL's own parts, the way its `sota-implementations` assemble them.

Where several documented ways exist, the one that ran fastest on two cores is used: `SerialEnv`, GAE once per
rollout, one optimizer, indices drawn once per epoch. `compiled` wraps `update` in `torch.compile`, as their
`compile.compile=1` does.
"""

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    DoubleToFloat,
    EnvBase,
    GymEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss, SACLoss, SoftUpdate
from torchrl.objectives.value import GAE

warnings.filterwarnings("ignore", module="tensordict|torchrl")

Update = Callable[[TensorDictBase], TensorDictBase]


def make_env(env_id: str, num_envs: int) -> EnvBase:
    """`num_envs` copies of a Gymnasium env stepped in this process, with TorchRL's episode bookkeeping."""
    env = GymEnv(env_id) if num_envs == 1 else SerialEnv(num_envs, lambda: GymEnv(env_id))
    env = TransformedEnv(env)
    for transform in (RewardSum(), StepCounter(), DoubleToFloat()):
        env.append_transform(transform)
    return env


def ppo_nets(env: EnvBase, hidden: tuple[int, ...] = (64, 64)) -> tuple[ProbabilisticActor, ValueOperator]:
    """A Gaussian actor with a state-independent scale and a value net, both tanh."""
    sizes, actions = env.observation_spec["observation"].shape[-1], env.action_spec_unbatched.shape[-1]
    body = partial(MLP, in_features=sizes, num_cells=list(hidden), activation_class=nn.Tanh)
    policy = nn.Sequential(body(out_features=actions), AddStateIndependentNormalScale(actions))
    actor = ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    return actor, ValueOperator(body(out_features=1), in_keys=["observation"])


def ppo_loss(actor: ProbabilisticActor, critic: ValueOperator) -> ClipPPOLoss:
    """The clipped loss with the settings of the contest: squared error, no entropy bonus."""
    return ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=0.2,
        entropy_bonus=False,
        critic_coeff=0.5,
        loss_critic_type="l2",
        normalize_advantage=True,
    )


def ppo_update(
    loss: ClipPPOLoss, learning_rate: float = 3e-4, max_grad_norm: float = 0.5, compiled: bool = False
) -> Update:
    """One minibatch step as TorchRL's examples write it; returns the detached losses."""
    parameters = list(loss.parameters())
    optimizer = torch.optim.Adam(parameters, lr=torch.tensor(learning_rate) if compiled else learning_rate, eps=1e-5)

    def update(batch: TensorDictBase) -> TensorDictBase:
        optimizer.zero_grad(set_to_none=True)
        losses = loss(batch)
        (losses["loss_objective"] + losses["loss_critic"]).backward()
        nn.utils.clip_grad_norm_(parameters, max_grad_norm)
        optimizer.step()
        return losses.detach()

    return torch.compile(update) if compiled else update


def ppo(
    seed: int, *, env_id: str, num_envs: int, steps: int, epochs: int, minibatch: int, compiled: bool
) -> Iterator[int]:
    """Train PPO; yields the frames done after each rollout."""
    torch.manual_seed(seed)
    env = make_env(env_id, num_envs)
    env.set_seed(seed)
    actor, critic = ppo_nets(env)
    size = num_envs * steps
    collector = Collector(env, actor, frames_per_batch=size, total_frames=-1)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    update = ppo_update(ppo_loss(actor, critic), compiled=compiled)
    frames = 0
    for rollout in collector:
        with torch.no_grad():
            batch = gae(rollout).reshape(-1)
        for _ in range(epochs):
            for rows in torch.randperm(size).split(minibatch):
                update(batch[rows])
        collector.update_policy_weights_()
        frames += size
        yield frames


def sac_nets(env: EnvBase, hidden: tuple[int, ...] = (256, 256)) -> tuple[ProbabilisticActor, ValueOperator]:
    """A tanh-Gaussian actor and one action-value net (`SACLoss` makes the second), both ReLU."""
    space: Any = env.action_spec_unbatched.space
    sizes, actions = env.observation_spec["observation"].shape[-1], env.action_spec_unbatched.shape[-1]
    body = partial(MLP, num_cells=list(hidden), activation_class=nn.ReLU)
    policy = nn.Sequential(body(in_features=sizes, out_features=2 * actions), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["loc", "scale"]),
        spec=env.action_spec_unbatched,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": space.low, "high": space.high, "tanh_loc": False},
        return_log_prob=False,
    )
    return actor, ValueOperator(body(in_features=sizes + actions, out_features=1), in_keys=["action", "observation"])


def sac_update(loss: SACLoss, learning_rate: float = 3e-4, tau: float = 0.005, compiled: bool = False) -> Update:
    """One SAC step as TorchRL's example writes it: losses summed, one Adam, then the target nets."""
    targets = SoftUpdate(loss, tau=tau)
    optimizer = torch.optim.Adam(
        [p for p in loss.parameters() if p.requires_grad],
        lr=torch.tensor(learning_rate) if compiled else learning_rate,
    )

    def update(batch: TensorDictBase) -> TensorDictBase:
        losses = loss(batch)
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).sum().backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        targets.step()
        return losses.detach()

    return torch.compile(update) if compiled else update


def sac(
    seed: int, *, env_id: str, batch_size: int, random_frames: int, chunk: int, buffer: int, compiled: bool
) -> Iterator[int]:
    """Train SAC, `chunk` frames then `chunk` updates; yields the frames done after each chunk."""
    torch.manual_seed(seed)
    env = make_env(env_id, 1)
    env.set_seed(seed)
    actor, critic = sac_nets(env)
    loss = SACLoss(
        actor,
        critic,
        num_qvalue_nets=2,
        loss_function="l2",
        delay_actor=False,
        delay_qvalue=True,
        alpha_init=1.0,
    )
    loss.make_value_estimator(gamma=0.99)
    update = sac_update(loss, compiled=compiled)
    collector = Collector(env, actor, frames_per_batch=chunk, total_frames=-1, init_random_frames=random_frames)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(buffer), batch_size=batch_size)
    frames = 0
    for data in collector:
        collector.update_policy_weights_()
        replay.extend(data.reshape(-1))
        frames += chunk
        if frames >= random_frames:
            for _ in range(chunk):
                update(replay.sample())
        yield frames
