"""Planted mistakes in assembled agents, and the page that lists what they are answered with.

    python -m tests.updates.mistakes        writes docs/pages/swap/errors.md

Each function makes one mistake; its docstring names it. The test runs them all and compares the page.
"""

import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
import torchrl.objectives
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform

from pgkit import advantages, collectors, data, envs, losses, modules, updates
from pgkit.errors import UserError

PAGE = Path(__file__).parents[2] / "docs" / "pages" / "swap" / "errors.md"


class Agent:
    """PPO on Pendulum, with one rollout of its own; every part can be replaced before ``train``."""

    def __init__(self, env_id: str = "Pendulum-v1") -> None:
        torch.manual_seed(0)
        self.env = envs.make(env_id, num_envs=2)
        discrete = env_id == "CartPole-v1"
        self.actor = (modules.categorical_actor if discrete else modules.gaussian_actor)(self.env, hidden=(8,))
        self.critic = modules.state_value(self.env, hidden=(8,))
        self.loss: Any = losses.ClipPPOLoss(self.actor, self.critic)
        self.advantage: Any = advantages.GAE(self.critic, gamma=0.99, lmbda=0.95)
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.rollout = collectors.VectorCollector(self.env, self.actor, frames_per_batch=64).rollout()

    def train(self) -> None:
        optimizer = torch.optim.Adam(self.parameters)
        updates.OnPolicyUpdate(self.loss, self.advantage, optimizer, minibatch_size=32, compile="off")(self.rollout)


class ReplayAgent:
    """SAC on Pendulum; every part can be replaced before ``train``."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.env = envs.make("Pendulum-v1")
        self.actor, critics = modules.tanh_normal_actor(self.env, (8,)), modules.q_value(self.env, hidden=(8,))
        self.loss: Any = losses.SACLoss(self.actor, critics, gamma=0.99)
        self.buffer: Any = data.ReplayBuffer(self.env, 100)
        self.rollout = collectors.VectorCollector(self.env, self.actor, frames_per_batch=64).rollout()

    def torchrl_buffer(self, *transforms: Any) -> None:
        self.buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=32)
        for transform in transforms:
            self.buffer.append_transform(transform)

    def train(self) -> None:
        optimizer = torch.optim.Adam(self.loss.parameters())
        updates.OffPolicyUpdate(
            self.loss, self.buffer, optimizer, batch_size=32, learning_starts=32, compile="off"
        )(self.rollout)  # fmt: skip


class MyAdvantage(TensorDictModuleBase):
    """Reward to go minus its mean, made wrong by ``spoil``."""

    def __init__(self, spoil: Callable[[TensorDictBase], Any], out_keys: tuple[str, ...]) -> None:
        super().__init__()
        self.spoil, self.in_keys, self.out_keys = spoil, [("next", "reward")], list(out_keys)

    def forward(self, rollout: TensorDictBase) -> TensorDictBase:
        reward = rollout["next", "reward"]
        rollout["advantage"], rollout["value_target"] = reward - reward.mean(), reward
        self.spoil(rollout)
        return rollout


def no_advantage_block() -> None:
    """The update has no advantage block."""
    agent = Agent()
    agent.advantage = None
    agent.train()


def advantage_under_another_name() -> None:
    """The advantage block writes its result under a name that the loss does not read."""
    agent = Agent()
    agent.advantage = MyAdvantage(lambda rollout: rollout.rename_key_("advantage", "adv"), ("adv", "value_target"))
    agent.train()


def advantage_without_the_trailing_1() -> None:
    """The advantage block drops the last dimension, which TorchRL's loss would broadcast to 32 x 32."""
    agent = Agent()
    agent.loss = torchrl.objectives.ClipPPOLoss(agent.actor, agent.critic)
    agent.advantage = MyAdvantage(
        lambda rollout: rollout.set("advantage", rollout["advantage"].squeeze(-1)), ("advantage", "value_target")
    )
    agent.train()


def log_probability_with_a_trailing_1() -> None:
    """The actor's log-probability has one number too many dimensions."""
    agent = Agent()
    agent.rollout["action_log_prob"] = agent.rollout["action_log_prob"].unsqueeze(-1)
    agent.train()


def no_log_probability() -> None:
    """The rollout has no log-probability."""
    agent = Agent()
    agent.rollout = agent.rollout.exclude("action_log_prob")
    agent.train()


def no_distribution_of_the_old_policy() -> None:
    """A loss with a KL penalty has no distribution to measure it from."""
    agent = Agent()
    agent.loss = losses.KLPENPPOLoss(agent.actor, agent.critic)
    agent.train()


def random_actions_in_the_rollout() -> None:
    """PPO trains on frames collected with random actions, by ``init_random_frames``."""
    agent = Agent()
    collector = collectors.VectorCollector(agent.env, agent.actor, frames_per_batch=64, init_random_frames=64)
    agent.rollout = collector.rollout()
    agent.train()


def observation_of_another_type() -> None:
    """The environment's observations are float64, the networks float32."""
    agent = Agent()
    agent.rollout["observation"] = agent.rollout["observation"].double()
    agent.advantage = MyAdvantage(lambda rollout: None, ("advantage", "value_target"))
    agent.train()


def observation_on_another_device() -> None:
    """The networks are on another device than the batch."""
    agent = Agent()
    agent.loss = losses.ClipPPOLoss(agent.actor.to("meta"), agent.critic)
    agent.train()


def network_of_another_environment() -> None:
    """The actor was built for an environment with other observations."""
    agent = Agent()
    other = modules.gaussian_actor(envs.make("HalfCheetah-v5"), hidden=(8,))
    agent.loss = losses.ClipPPOLoss(other, agent.critic)
    agent.parameters = [*other.parameters(), *agent.critic.parameters()]
    agent.train()


def discrete_actions_for_a_gaussian() -> None:
    """The actions are indices, the actor is a Gaussian."""
    agent = Agent()
    agent.rollout["action"] = torch.ones(agent.rollout.batch_size, dtype=torch.int64)
    agent.train()


def action_out_of_range() -> None:
    """The actor has fewer discrete actions than the rollout."""
    agent = Agent("CartPole-v1")
    agent.rollout["action"] = agent.rollout["action"] + 1
    agent.train()


def action_outside_the_bounds() -> None:
    """The squashed actor's bounds are not those of the environment that collected."""
    agent = ReplayAgent()
    agent.rollout["action"] = 3 * agent.rollout["action"].sign()
    agent.train()


def reward_without_the_trailing_1() -> None:
    """The rewards in the replay have no last dimension."""
    agent = ReplayAgent()
    agent.torchrl_buffer()
    agent.rollout["next", "reward"] = agent.rollout["next", "reward"].squeeze(-1)
    agent.train()


def flags_as_numbers() -> None:
    """``terminated`` is 0 or 1 in place of a flag."""
    agent = ReplayAgent()
    agent.torchrl_buffer()
    agent.rollout["next", "terminated"] = agent.rollout["next", "terminated"].float()
    agent.train()


def parameter_without_optimizer() -> None:
    """The optimizer was built from the actor alone."""
    agent = Agent()
    agent.parameters = [*agent.actor.parameters()]
    agent.train()


def optimizer_of_another_agent() -> None:
    """The optimizer holds parameters that no loss reaches."""
    agent = Agent()
    agent.parameters += [*modules.state_value(agent.env, hidden=(8,)).parameters()]
    agent.train()


def frozen_parameter_in_the_optimizer() -> None:
    """The optimizer holds a parameter that was frozen."""
    agent = Agent()
    agent.parameters[0].requires_grad_(False)
    agent.train()


def two_critics() -> None:
    """The advantage block has a critic of its own, which nothing trains."""
    agent = Agent()
    agent.advantage = advantages.GAE(modules.state_value(agent.env, hidden=(8,)))
    agent.train()


def two_owners_of_gamma() -> None:
    """The loss's own value estimator has another discount than the advantage block."""
    agent = Agent()
    agent.loss.make_value_estimator(gamma=0.9, lmbda=0.95)
    agent.train()


def two_owners_of_gamma_in_the_replay() -> None:
    """The replay's n-step transform has another discount than the loss."""
    agent = ReplayAgent()
    agent.torchrl_buffer(MultiStepTransform(n_steps=3, gamma=0.9))
    agent.train()


def two_owners_of_lambda() -> None:
    """The same with lambda."""
    agent = Agent()
    agent.loss.make_value_estimator(gamma=0.99, lmbda=0.5)
    agent.train()


def a_loss_a_row() -> None:
    """The loss returns one number a row."""
    agent = Agent()
    agent.loss = losses.ClipPPOLoss(agent.actor, agent.critic, reduction="none")
    agent.train()


def no_loss_entry() -> None:
    """A loss of your own returns its result under a name that does not begin with ``loss_``."""
    agent = Agent()
    stock = agent.loss.forward
    agent.loss.forward = lambda batch: stock(batch).select("loss_objective").rename_key_("loss_objective", "objective")
    agent.train()


def own_loss_that_broadcasts() -> None:
    """A loss of your own multiplies log-probabilities ``(B,)`` with advantages ``(B, 1)``."""
    agent = Agent()

    class Mine(losses.PolicyLoss):
        def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
            log_prob = self.log_prob(self.distribution(tensordict), tensordict)
            error = self.value(tensordict) - tensordict["value_target"]
            objective = (log_prob * tensordict["advantage"]).mean()
            return TensorDict({"loss_objective": -objective, "loss_critic": error.square().mean()})

        def _writes(self) -> list[Any]:
            return ["loss_objective", "loss_critic"]

    agent.loss = Mine(agent.actor, agent.critic)
    agent.train()


def flattened_rollout() -> None:
    """The rollout of several environments was flattened, so that an advantage would run from one into the next."""
    agent = Agent()
    agent.rollout = agent.rollout.reshape(-1)
    agent.train()


def shuffled_rollout() -> None:
    """The steps of a rollout were shuffled, so that the next value would be that of another step."""
    agent = Agent()
    agent.rollout = agent.rollout[:, torch.randperm(agent.rollout.shape[1])]
    agent.train()


def empty_rollout() -> None:
    """The rollout has no steps."""
    agent = Agent()
    agent.rollout = agent.rollout[:, :0]
    agent.train()


def advantage_of_the_actor() -> None:
    """The advantage block was given the actor in place of the critic."""
    agent = Agent()
    agent.advantage = advantages.GAE(agent.actor)
    agent.train()


def critic_of_two_values() -> None:
    """The critic has two outputs."""
    agent = Agent()
    agent.critic = TensorDictModule(torch.nn.Linear(3, 2), ["observation"], ["state_value"])
    agent.loss, agent.advantage = losses.ClipPPOLoss(agent.actor, agent.critic), advantages.GAE(agent.critic)
    agent.train()


def advantage_with_a_gradient() -> None:
    """An advantage block of your own keeps the graph of its critic."""
    agent = Agent()
    agent.advantage = MyAdvantage(
        lambda rollout: rollout.set("advantage", agent.critic(rollout.copy())["state_value"]),
        ("advantage", "value_target"),
    )
    agent.train()


def critics_of_states() -> None:
    """An off-policy loss was given a critic of states in place of critics of actions."""
    agent = ReplayAgent()
    agent.loss = losses.SACLoss(agent.actor, modules.state_value(agent.env, hidden=(8,)))
    agent.train()


def shared_parameter_twice() -> None:
    """Actor and critic share layers, and the optimizer has both lists of parameters."""
    agent = Agent()
    agent.parameters += [*agent.critic.parameters()]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's, which many a log hides
        agent.train()


class Weighted(losses.SACLoss):
    """Reads how likely the collected action was."""

    def _reads(self) -> list[Any]:
        return [*super()._reads(), "action_log_prob"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        behaviour = tensordict["action_log_prob"].mean()
        return super().forward(tensordict).set("behaviour_entropy", -behaviour)


def an_entry_that_the_replay_does_not_keep() -> None:
    """A loss reads more of the collected frames than a replay buffer keeps by itself."""
    agent = ReplayAgent()
    agent.loss = Weighted(agent.loss.actor_network, agent.loss.qvalue_network, gamma=0.99)
    agent.train()


MISTAKES: list[Callable[[], None]] = [
    no_advantage_block, advantage_under_another_name, advantage_without_the_trailing_1,
    log_probability_with_a_trailing_1, no_log_probability, no_distribution_of_the_old_policy,
    random_actions_in_the_rollout, observation_of_another_type,
    observation_on_another_device, network_of_another_environment, discrete_actions_for_a_gaussian,
    action_out_of_range, action_outside_the_bounds, reward_without_the_trailing_1, flags_as_numbers,
    parameter_without_optimizer, optimizer_of_another_agent, frozen_parameter_in_the_optimizer, two_critics,
    two_owners_of_gamma, two_owners_of_gamma_in_the_replay, two_owners_of_lambda, a_loss_a_row, no_loss_entry,
    own_loss_that_broadcasts, flattened_rollout, shuffled_rollout, empty_rollout,
    advantage_of_the_actor, critic_of_two_values, shared_parameter_twice,
    advantage_with_a_gradient, critics_of_states, an_entry_that_the_replay_does_not_keep,
]  # fmt: skip


@cache
def message(mistake: Callable[[], None]) -> str:
    """What the mistake is answered with."""
    try:
        mistake()
    except UserError as error:
        return str(error)
    raise AssertionError(f"{mistake.__name__} was not found")


def section(mistake: Callable[[], None]) -> str:
    """The page's section of a mistake."""
    return f"## {(mistake.__doc__ or '').rstrip('.').replace('``', '`')}\n\n```text\nerror: {message(mistake)}\n```\n"


INTRO = """# Errors

An update checks the assembled agent once, before its first step: entries, shapes, types, devices, actions, parameters,
and that gamma and lambda have one owner. A mistake gives one line. It names the entry or parameter, who writes it and
who reads it, what was expected and what was found. A shape `(B,)` in place of `(B, 1)` is never broadcast.

`print(update)`, or `pgkit run ppo --explain`, shows before the training who writes and who reads each entry:

```text
{diagram}
```

`tests/updates/mistakes.py` makes these mistakes on purpose and writes this page; a test compares the two.
"""


def page() -> str:
    """The whole page."""
    agent = Agent("CartPole-v1")
    update = updates.OnPolicyUpdate(agent.loss, agent.advantage, torch.optim.Adam(agent.parameters))
    return "\n".join([INTRO.format(diagram=update), *map(section, MISTAKES)])


if __name__ == "__main__":
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text(page(), encoding="utf-8")
