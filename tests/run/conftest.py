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
from torchrl.data import Bounded, Composite, Unbounded

from pgkit import run
from pgkit.run import Agent, RunArgs


class CountingArrays:
    """Slot ``i`` plays episodes of ``i + 1`` steps; a reward is ``seed + number of the episode``."""

    def __init__(self, num_envs: int, seed: int):
        self.num_envs, self.seed = num_envs, seed
        self.actions: list[np.ndarray] = []
        self.reset()

    def reset(self) -> np.ndarray:
        self.obs = np.zeros((self.num_envs, 2), np.float32)
        self._reward, self._steps, self._episode = (np.zeros(self.num_envs) for _ in range(3))
        self._fresh = np.ones(self.num_envs, bool)
        return self.obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        self.actions.append(np.array(action))
        self._reward[self._fresh] = self._steps[self._fresh] = 0
        reward = (self.seed + self._episode).astype(np.float32)
        self._reward += reward
        self._steps += 1
        done = self._steps == np.arange(self.num_envs) + 1
        self._episode[done] += 1
        self._fresh = done
        self.episode_reward, self.step_count = self._reward.copy(), self._steps.astype(int)
        return self.obs, reward, done, np.zeros_like(done)


class CountingEnv:
    action_spec_unbatched = Bounded(-1.0, 1.0, torch.Size([1]))
    observation_spec_unbatched = Composite(observation=Unbounded(torch.Size([2])))

    def __init__(self, num_envs: int, seed: int):
        _ = torch.rand(1), np.random.rand()  # an env whose construction draws from the global generators
        self.arrays = CountingArrays(num_envs, seed)

    def set_seed(self, seed: int) -> None:
        self.arrays.seed = seed % 100

    def close(self) -> None: ...


@dataclass
class CountingArgs(RunArgs):
    """The settings of a recipe with an environment of its own."""

    def make_env(self, num_envs: int, seed: int, workers: int = 1) -> Any:
        return CountingEnv(num_envs, seed)


def agent(args: CountingArgs, env: CountingEnv) -> Agent:
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
