from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs.utils import check_env_specs

from pgkit import envs
from pgkit.errors import UserError


class Sensors(gym.Env):
    """Two entries that count the steps; ten steps an episode."""

    observation_space = spaces.Dict(
        {"picture": spaces.Box(0, 99, (1, 4, 4), np.float32), "speed": spaces.Box(-99, 99, (2,), np.float32)}
    )
    action_space = spaces.Box(-1, 1, (1,))

    def _observe(self) -> dict[str, Any]:
        return {"picture": np.arange(16, dtype=np.float32).reshape(1, 4, 4), "speed": np.array([self.t, -self.t], "f4")}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return self._observe(), 0.0, False, self.t == 10, {}


class Mixed(Sensors):
    """One entry of every kind."""

    observation_space = spaces.Dict(
        {"mode": spaces.Discrete(3), "flags": spaces.MultiBinary(2), "level": spaces.Box(0, 1, (), np.float32)}
    )

    def _observe(self) -> dict[str, Any]:
        return {"mode": 2, "flags": np.array([0, 1], np.int8), "level": np.float32(0.5)}


@pytest.mark.parametrize("make", [Sensors, Mixed])
def test_entries_apart_are_the_flat_ones(make):
    flat, apart = envs.make(make, num_envs=2, seed=1), envs.make(make, num_envs=2, seed=1, flatten=False)
    check_env_specs(apart)
    a, b = (env.set_seed(1) and env.rollout(5) for env in (flat, apart))
    names = list(make.observation_space)
    for get in (lambda td: td, lambda td: td["next"]):
        side_by_side = torch.cat([get(b)[name].flatten(2).float() for name in names], -1)
        assert torch.equal(get(a)["observation"], side_by_side)
        assert "observation" not in set(get(b).keys())


def test_shapes_and_types():
    td = envs.make(Sensors, num_envs=2, flatten=False).reset()
    assert td["picture"].dtype == td["speed"].dtype == torch.float32
    assert torch.equal(td["picture"][1], torch.arange(16.0).view(1, 4, 4)) and td["speed"].shape == (2, 2)
    td = envs.make(Mixed, num_envs=2, flatten=False).reset()
    assert td["mode"].tolist() == [[0, 0, 1]] * 2 and td["level"].tolist() == [[0.5]] * 2
    assert td["flags"].tolist() == [[False, True]] * 2


def test_mistakes():
    with pytest.raises(UserError, match="flatten=False keeps the entries of a Dict observation apart"):
        envs.make("CartPole-v1", flatten=False)

    class Taken(Sensors):
        observation_space = spaces.Dict({"reward": spaces.Box(0, 1, (1,))})

    with pytest.raises(UserError, match="'reward' has a name that rollouts use"):
        envs.make(Taken, flatten=False)


def test_the_cue_of_the_maze_is_seen_once_and_decides():
    for cue in (0, 1):
        env = gym.make("pgkit/TMaze-v0")
        for seed in range(20):
            obs, _ = env.reset(seed=seed)
            if obs[0] == 2 * cue - 1:
                break
        seen = [env.step(1)[0].tolist() for _ in range(8)]
        assert seen == [[0, 0]] * 7 + [[0, 1]]
        assert env.step(1)[1:3] == (-0.1, False)
        assert env.step(2)[1:3] == (2.0 * cue - 1, True)
