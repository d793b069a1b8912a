"""A vector env small enough to count by hand, and a recipe on it."""

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from pgkit import envs, run
from pgkit.run import Agent, RunArgs
from pgkit.seams import Step


def clip(action: np.ndarray) -> np.ndarray:
    return np.clip(action, -1.0, 1.0)


class CountingSimulator:
    """Slot ``i`` plays episodes of ``i + 1`` steps; a reward is ``seed % 100 + number of the episode``."""

    device, resume, masks = torch.device("cpu"), "exact", False

    def __init__(self, num_envs: int, seed: int):
        _ = torch.rand(1), np.random.rand()  # an env whose construction draws from the global generators
        self.num_envs, self.seed = num_envs, seed
        self.actions: list[torch.Tensor] = []
        flag = Categorical(2, (num_envs, 1), dtype=torch.bool)
        self.observation_spec = Composite(observation=Unbounded((num_envs, 2)), shape=(num_envs,))
        self.action_spec = Composite(action=Bounded(-1.0, 1.0, (num_envs, 1)), shape=(num_envs,))
        self.reward_spec = Composite(reward=Unbounded((num_envs, 1)), shape=(num_envs,))
        self.done_spec = Composite(done=flag, terminated=flag, truncated=flag, shape=(num_envs,))
        self.info_spec = Composite(shape=(num_envs,))
        self.to_env = clip
        self.reset()

    def reset(self, seed: int | None = None, rows: Any = None) -> dict[Any, torch.Tensor]:
        self.seed = self.seed if seed is None else seed % 100
        self._steps, self._episode = torch.zeros(2, self.num_envs, dtype=torch.int64)
        self._reward, self._begun = torch.zeros(self.num_envs, 1), torch.ones(self.num_envs, dtype=torch.bool)
        return {"observation": torch.zeros(self.num_envs, 2)}

    def step(self, action: dict[Any, torch.Tensor]) -> Step:
        self.actions.append(action["action"].clone())
        self._reward[self._begun], self._steps[self._begun] = 0.0, 0
        reward = (self.seed + self._episode).float().unsqueeze(-1)
        self._reward += reward
        self._steps += 1
        done = (self._steps == torch.arange(self.num_envs) + 1).unsqueeze(-1)
        self._begun = done.squeeze(-1)
        self._episode += self._begun
        self.episode_reward, self.step_count = {"reward": self._reward.clone()}, self._steps.clone()
        obs = {"observation": torch.zeros(self.num_envs, 2)}
        return Step(obs, {"reward": reward}, {"terminated": done}, {"truncated": done & False}, {}, obs)

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> dict[Any, torch.Tensor]:
        return self.reset()

    def close(self) -> None: ...


def CountingEnv(num_envs: int, seed: int) -> envs.VectorEnv:
    return envs.VectorEnv(lambda first, count, seed: CountingSimulator(count, seed), num_envs, seed)


@dataclass
class CountingArgs(RunArgs):
    """The settings of a recipe with an environment of its own."""

    def make_env(self, num_envs: int, seed: int, workers: int = 1) -> Any:
        return CountingEnv(num_envs, seed)


def agent(args: CountingArgs, env: envs.VectorEnv) -> Agent:
    """What :func:`train` trains."""
    return Agent(linear_policy(1.0))


class Counter:
    """The state of a recipe that does nothing."""

    def __init__(self) -> None:
        self.frames = 0

    def state_dict(self) -> dict[str, Any]:
        return {"frames": self.frames}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.frames = state_dict["frames"]


def linear_policy(weight: float = 0.0) -> TensorDictModule:
    """``action = weight * (sum of the observation)``."""
    linear = torch.nn.Linear(2, 1, bias=False)
    torch.nn.init.constant_(linear.weight, weight)
    return TensorDictModule(linear, in_keys=["observation"], out_keys=["action"])


def ended(frames: int) -> TensorDict:
    """One episode that ended, of return ``frames`` and length 5."""
    following = {"episode_reward": torch.full((1, 1, 1), float(frames)), "step_count": torch.full((1, 1, 1), 5)}
    return TensorDict({"next": {**following, "done": torch.ones(1, 1, 1, dtype=torch.bool)}}, [1, 1])


def train(
    args: RunArgs, recipe: str = "walk", hook: Callable[[int], None] | None = None, every: int = 1, **extra: Any
) -> run.Run:
    """Ten frames a step; the one metric is drawn from the global generator, so it shows where that stands."""
    with run.Run(args, recipe) as log:
        counter = Counter()
        log.track(policy=linear_policy(), eval_env=CountingEnv, counter=counter, **extra)
        while counter.frames < args.total_frames:
            counter.frames += 10
            drawn = {"draw": torch.rand(()).item() + np.random.rand()}
            log.step(counter.frames, ended(counter.frames), drawn, every=every)
            if hook:
                hook(counter.frames)
    return log


@pytest.fixture
def kit() -> SimpleNamespace:
    return SimpleNamespace(
        Args=CountingArgs, Env=CountingEnv, Counter=Counter, policy=linear_policy, agent=agent, train=train
    )
