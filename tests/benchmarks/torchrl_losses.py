"""One gradient step of each stock TorchRL loss: in pgkit's compiled update, and in TorchRL's own loop.

    python tests/benchmarks/torchrl_losses.py

On-policy losses: 64 rows of a HalfCheetah rollout, 2x64 tanh nets, gradient norm clipped to 0.5. Off-policy losses:
256 rows drawn from a replay of HalfCheetah frames (CartPole for discrete actions), 2x256 ReLU nets, soft targets.
TorchRL's loop: Adam's ``step()`` and ``SoftUpdate.step()`` after ``backward()``, rows from its
``TensorDictReplayBuffer``.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import torchrl.objectives as stock
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import MLP, DistributionalQValueActor, QValueActor
from torchrl.objectives.value import GAE

from pgkit import collectors, data, envs, modules, updates

Hidden = Sequence[int]


@dataclass
class Agent:
    """An environment, the module that acts in it, and a stock loss."""

    env: Any
    actor: Any
    loss: Any
    critic: Any = None


def on_policy(name: str, hidden: Hidden = (64, 64)) -> Agent:
    """A Gaussian agent with the stock loss ``name``."""
    env = envs.make("HalfCheetah-v5", num_envs=4)
    actor, critic = modules.gaussian_actor(env, hidden), modules.state_value(env, hidden)
    return Agent(env, actor, getattr(stock, name)(actor, critic), critic)


def off_policy(name: str, hidden: Hidden = (256, 256)) -> Agent:
    """An agent with replay and the stock loss ``name``, its discount 0.99."""
    discrete = name in ("DiscreteSACLoss", "DQNLoss", "DistributionalDQNLoss")
    env = envs.make("CartPole-v1" if discrete else "HalfCheetah-v5", num_envs=4)
    make: dict[str, Callable[..., Agent]] = {
        "DQNLoss": _dqn, "DistributionalDQNLoss": _distributional_dqn, "DiscreteSACLoss": _discrete_sac,
        "DDPGLoss": _deterministic, "TD3Loss": _deterministic,
    }  # fmt: skip
    agent = make.get(name, _soft)(name, env, hidden)
    if name != "DistributionalDQNLoss":  # takes its discount itself
        agent.loss.make_value_estimator(gamma=0.99)
    return agent


def _soft(name: str, env: Any, hidden: Hidden) -> Agent:
    actor = modules.tanh_normal_actor(env, hidden)
    count = {"REDQLoss": 10, "TQCLoss": 5}.get(name, 2)
    critics = [_critic(env, hidden, 25 if name == "TQCLoss" else 1) for _ in range(count)]
    loss = getattr(stock, name)(actor, critics, num_qvalue_nets=count, action_spec=env.action_spec_unbatched)
    return Agent(env, actor, loss)


def _deterministic(name: str, env: Any, hidden: Hidden) -> Agent:
    actor, critic = modules.deterministic_actor(env, hidden), _critic(env, hidden, 1)
    kwargs = {"action_spec": env.action_spec_unbatched} if name == "TD3Loss" else {}
    return Agent(env, actor, getattr(stock, name)(actor, critic, **kwargs))


def _discrete_sac(name: str, env: Any, hidden: Hidden) -> Agent:
    actor = modules.categorical_actor(env, hidden, nn.ReLU)
    critic = TensorDictModule(_mlp(4, 2, hidden), in_keys=["observation"], out_keys=["action_value"])
    loss = stock.DiscreteSACLoss(actor, critic, action_space="categorical", num_actions=2, num_qvalue_nets=2)
    return Agent(env, actor, loss)


def _dqn(name: str, env: Any, hidden: Hidden) -> Agent:
    actor = QValueActor(_mlp(4, 2, hidden), in_keys=["observation"], action_space="categorical")
    return Agent(env, actor, stock.DQNLoss(actor, action_space="categorical", delay_value=True))


def _distributional_dqn(name: str, env: Any, hidden: Hidden) -> Agent:
    net = TensorDictSequential(
        TensorDictModule(_mlp(4, (51, 2), hidden), in_keys=["observation"], out_keys=["action_value"]),
        TensorDictModule(nn.LogSoftmax(-2), in_keys=["action_value"], out_keys=["action_value"]),
    )
    actor = DistributionalQValueActor(net, support=torch.linspace(0, 100, 51), action_space="categorical")
    return Agent(env, actor, stock.DistributionalDQNLoss(actor, gamma=0.99, delay_value=True))


def _mlp(features: int, outputs: Any, hidden: Hidden) -> nn.Module:
    return MLP(in_features=features, out_features=outputs, num_cells=list(hidden), activation_class=nn.ReLU)


def _critic(env: Any, hidden: Hidden, outputs: int) -> TensorDictModule:
    class Joined(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            sizes = env.observation_spec["observation"].shape[-1] + env.action_spec.shape[-1]
            self.net = _mlp(sizes, outputs, hidden)

        def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            return self.net(torch.cat([observation, action], -1))

    return TensorDictModule(Joined(), in_keys=["observation", "action"], out_keys=["state_action_value"])


ON_POLICY = ("ClipPPOLoss", "KLPENPPOLoss", "A2CLoss", "ReinforceLoss")
OFF_POLICY = (
    "SACLoss", "TD3Loss", "DDPGLoss", "REDQLoss", "TQCLoss", "CrossQLoss", "DiscreteSACLoss", "DQNLoss",
    "DistributionalDQNLoss",
)  # fmt: skip


def rollout(agent: Agent, frames: int) -> TensorDictBase:
    """Frames of the agent, with the parameters of its distribution where it has one (KLPENPPO reads them)."""
    found = next(iter(collectors.VectorCollector(agent.env, agent.actor, frames_per_batch=frames, compile="off")))
    if hasattr(agent.actor, "get_dist_params"):
        with torch.no_grad():
            found.update(agent.actor.get_dist_params(found.select("observation")).detach())
    return found


def on_policy_update(agent: Agent, compile: str, minibatch_size: int = 64, epochs: int = 1) -> updates.OnPolicyUpdate:
    """pgkit's update around the stock loss and TorchRL's GAE."""
    return updates.OnPolicyUpdate(
        loss=agent.loss,
        advantage=GAE(gamma=0.99, lmbda=0.95, value_network=agent.critic),
        optimizer=torch.optim.Adam(agent.loss.parameters(), lr=3e-4),
        epochs=epochs,
        minibatch_size=minibatch_size,
        compile=compile,
        seed=0,
    )


def off_policy_update(agent: Agent, compile: str, buffer: Any = None, batch_size: int = 256) -> updates.OffPolicyUpdate:
    """pgkit's update around the stock loss and pgkit's replay."""
    return updates.OffPolicyUpdate(
        loss=agent.loss,
        buffer=data.ReplayBuffer(agent.env, 4096, seed=0) if buffer is None else buffer,
        optimizer=torch.optim.Adam(agent.loss.parameters(), lr=3e-4),
        batch_size=batch_size,
        learning_starts=batch_size,
        updates_per_step=0,
        compile=compile,
    )


def torchrl_loop(agent: Agent, draw: Callable[[], TensorDictBase], max_grad_norm: float | None) -> Callable[[], None]:
    """One step as TorchRL's examples write it."""
    optimizer = torch.optim.Adam(agent.loss.parameters(), lr=3e-4)
    delayed = any(name.startswith("target_") for name, _ in agent.loss.named_children())
    targets = stock.SoftUpdate(agent.loss, tau=0.005) if delayed else None

    def step() -> None:
        out = agent.loss(draw())
        torch.stack([out[key].sum() for key in out.keys() if key.startswith("loss")]).sum().backward()
        if max_grad_norm is not None:
            nn.utils.clip_grad_norm_(agent.loss.parameters(), max_grad_norm)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        if targets is not None:
            targets.step()

    return step


def times(name: str, steps: int) -> tuple[float, float]:
    """Milliseconds of a step in pgkit's update and in TorchRL's loop."""
    import contest

    if name in ON_POLICY:
        agent, other, per_call = on_policy(name), on_policy(name), 16
        frames = rollout(agent, 64 * per_call)
        update = on_policy_update(agent, "auto")
        flat = GAE(gamma=0.99, lmbda=0.95, value_network=other.critic)(frames.copy()).reshape(-1)
        theirs = torchrl_loop(other, lambda: flat[torch.randint(len(flat), (64,))], 0.5)
        update(frames.copy())
        step, rows = update._step, torch.arange(64)
        prepared = update._flatten(frames.copy())
        assert step is not None
        mine: Callable[[], Any] = lambda: step(prepared, rows)  # noqa: E731
    else:
        agent, other = off_policy(name), off_policy(name)
        frames = rollout(agent, 1024)
        update = off_policy_update(agent, "auto")
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(4096), batch_size=256)
        buffer.extend(frames.reshape(-1))
        update(frames)
        update.train(2)
        theirs, mine = torchrl_loop(other, buffer.sample, None), lambda: update.train(1)
    return contest.milliseconds(mine, steps), contest.milliseconds(theirs, steps)


@dataclass
class Options:
    """The stock losses in pgkit's update and in TorchRL's loop."""

    steps: int = 300
    """Steps that are timed, of which the median counts."""
    threads: int = 1
    """Threads for both."""
    losses: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Time only these; give the flag once a name."""


def main(options: Options) -> None:
    import contest

    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    print(f"{contest.machine()['text']}; {options.steps} steps, {options.threads} thread(s)\n")
    print("| TorchRL's loss | pgkit's update, ms | TorchRL's loop, ms | TorchRL / pgkit |\n|---|---|---|---|")
    for name in options.losses or (*ON_POLICY, *OFF_POLICY):
        mine, theirs = times(name, options.steps)
        print(f"| {name} | {mine:.2f} | {theirs:.2f} | {theirs / mine:.1f} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
