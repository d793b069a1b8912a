"""The simulators side by side: episodes' ends, what reaches the policy, types, info, and what envs.make takes."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, GymEnv, RewardSum, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from pgkit import envs
from pgkit.errors import UserError
from pgkit.seams import Simulator


class Steps(gym.Env):
    """Observes the number of the episode and the steps in it; slot ``length`` ends after so many steps."""

    observation_space, action_space = spaces.Box(-99, 99, (2,), np.float64), spaces.Box(-1, 1, (1,))

    def __init__(self, length: int = 2) -> None:
        self.length, self.episode = length, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        return np.array([self.episode, 0.0]), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        done = self.t == self.length
        return np.array([self.episode, self.t], float), float(self.t), False, done, {"is_success": done, "other": 1}


class TorchSteps(EnvBase):
    """The same in torch: slot ``i`` ends after ``i + 2`` steps."""

    at: torch.Tensor

    def __init__(self, num_envs: int = 2) -> None:
        super().__init__(batch_size=(num_envs,))
        n = num_envs
        self.observation_spec = Composite(observation=Unbounded((n, 2)), is_success=Unbounded((n, 1)), shape=(n,))
        self.action_spec, self.reward_spec = Bounded(-1, 1, (n, 1)), Unbounded((n, 1))
        flag = Categorical(2, (n, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag, truncated=flag, shape=(n,))
        self.register_buffer("at", torch.zeros(n, 2))

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        rows = torch.ones(len(self.at), dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            rows = tensordict["_reset"].flatten()
        self.at[rows] += torch.tensor([1.0, 0.0])
        self.at[rows, 1] = 0.0
        return TensorDict({"observation": self.at.clone(), "is_success": self.at[:, :1] * 0}, self.batch_size)

    def _step(self, tensordict: Any) -> TensorDict:
        self.seen = tensordict["action"]
        self.at[:, 1] += 1
        done = (self.at[:, 1] == torch.arange(len(self.at)) + 2).unsqueeze(-1)
        reward, never = self.at[:, 1:].clone(), torch.zeros_like(done)
        made = {"observation": self.at.clone(), "is_success": done.float(), "reward": reward}
        return TensorDict({**made, "done": done, "terminated": never, "truncated": done}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None: ...


def vector(mode: AutoresetMode) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Steps(2), lambda: Steps(3)], autoreset_mode=mode)


MODES = {
    "next step": lambda: vector(AutoresetMode.NEXT_STEP),
    "same step": lambda: vector(AutoresetMode.SAME_STEP),
    "disabled": lambda: vector(AutoresetMode.DISABLED),
    "torch": TorchSteps,
}


def one_by_one() -> envs.Gymnasium:
    return envs.Gymnasium([Steps(2), Steps(3)], info=("is_success",))


def play(simulator: Simulator, steps: int) -> list[list[Any]]:
    """For each slot, the steps that count: observation, next, reward, truncated, is_success, and the totals."""
    fresh = simulator.reset()["observation"].clone()
    slots: list[list[Any]] = [[] for _ in range(simulator.num_envs)]
    for _ in range(steps):
        made = simulator.step({"action": torch.zeros(simulator.num_envs, 1)})
        counts = torch.ones(simulator.num_envs, dtype=torch.bool) if made.mask is None else made.mask
        for i in counts.nonzero().flatten().tolist():
            slots[i].append(
                [
                    fresh[i].tolist(), made.next["observation"][i].tolist(), made.reward["reward"][i].item(),
                    made.truncated["truncated"][i].item(), made.terminated["terminated"][i].item(),
                    made.info["is_success"][i].item(), simulator.episode_reward["reward"][i].item(),
                    simulator.step_count[i].item(),
                ]
            )  # fmt: skip
        fresh = made.fresh["observation"].clone()
    return slots


@pytest.mark.parametrize("kind", MODES)
def test_every_simulator_tells_the_same_story(kind):
    expected = play(one_by_one(), 12)
    # slot 0: episodes of two steps with rewards 1 and 2; by hand
    assert expected[0][:3] == [
        [[1.0, 0.0], [1.0, 1.0], 1.0, False, False, 0.0, 1.0, 1],
        [[1.0, 1.0], [1.0, 2.0], 2.0, True, False, 1.0, 3.0, 2],
        [[2.0, 0.0], [2.0, 1.0], 1.0, False, False, 0.0, 1.0, 1],
    ]
    env = envs.make(MODES[kind](), info=("is_success",))
    assert isinstance(env.simulator, Simulator) and env.simulator.masks == (kind == "next step")
    found = play(env.simulator, 12)
    for mine, theirs in zip(found, expected, strict=True):
        assert mine == theirs[: len(mine)] and len(mine) >= 8


def test_next_step_masks_the_rows_whose_action_is_ignored():
    simulator = envs.make(MODES["next step"]()).simulator
    simulator.reset()
    masks: list[Any] = [simulator.step({"action": torch.zeros(2, 1)}).mask for _ in range(6)]
    # slot 0 ends after 2 steps and is reset in the third, slot 1 after 3 and in the fourth
    assert [mask.tolist() for mask in masks] == [
        [True, True],
        [True, True],
        [False, True],
        [True, False],
        [True, True],
        [False, True],
    ]


@pytest.mark.parametrize("kind", [*MODES, "one by one"])
def test_a_seed_starts_everything_anew_and_a_second_reset_nothing(kind):
    env = envs.make(lambda: gym.make("Pendulum-v1"), num_envs=2, seed=5)
    if kind in ("next step", "same step", "disabled"):
        mode = {"next step": "NextStep", "same step": "SameStep", "disabled": "Disabled"}[kind]
        env = envs.make(gym.make_vec("Pendulum-v1", num_envs=2, vector_kwargs={"autoreset_mode": mode}), seed=5)
    elif kind == "torch":
        env = envs.make(SerialEnv(2, lambda: GymEnv("Pendulum-v1")), seed=5)
    simulator = env.simulator
    first = simulator.reset()["observation"].clone()
    assert torch.equal(simulator.reset()["observation"], first)
    simulator.step({"action": torch.zeros(2, 1)})
    assert not torch.equal(simulator.reset()["observation"], first)
    assert torch.equal(simulator.reset(seed=5)["observation"], first)


def test_float64_becomes_float32_and_info_has_a_place():
    simulator = one_by_one()
    made = (simulator.reset(), simulator.step({"action": torch.zeros(2, 1)}))[1]
    assert made.next["observation"].dtype == torch.float32
    assert list(made.info) == ["is_success"] and simulator.info_spec["is_success"].shape == (2, 1)
    env = envs.make(lambda: gym.wrappers.RecordEpisodeStatistics(Steps()), info=("episode", "no_such"))
    env.simulator.reset()
    seen = [{k: x.item() for k, x in env.simulator.step({"action": torch.zeros(1, 1)}).info.items()} for _ in range(2)]
    assert np.isnan(seen[0]["episode", "r"]) and seen[1]["episode", "r"] == 3.0 and seen[1]["episode", "l"] == 2.0
    assert np.isnan(seen[1]["no_such"])
    shaped = envs.make(Steps, info={"other": Unbounded((1,), dtype=torch.int64)})
    shaped.simulator.reset()
    assert shaped.simulator.step({"action": torch.zeros(1, 1)}).info["other"].tolist() == [[1]]
    with pytest.raises(UserError, match="info='speed': TorchSteps observes observation, is_success"):
        envs.make(TorchSteps(), info=("speed",))


class Camera(gym.Env):
    """An image, alone or in a Dict, that counts steps."""

    action_space = spaces.Discrete(2)

    def __init__(self, apart: bool = False) -> None:
        image, speed = spaces.Box(0, 255, (3, 4, 4), np.uint8), spaces.Box(-1, 1, (2,), np.float64)
        ticks = spaces.Box(0, 9, (1,), np.int64)
        self.apart = apart
        self.observation_space = spaces.Dict(image=image, speed=speed, ticks=ticks) if apart else image

    def _observe(self) -> Any:
        image = np.full((3, 4, 4), 250 + self.t, np.uint8)
        return {"image": image, "speed": np.ones(2), "ticks": np.array([self.t])} if self.apart else image

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return self._observe(), 0.0, self.t == 5, False, {}


def test_types_of_observations(caplog):
    check_env_specs(envs.make(Camera, num_envs=2))
    image = envs.make(Camera).reset()["observation"]
    assert image.dtype == torch.uint8 and image.shape == (1, 3, 4, 4) and image.unique().tolist() == [250]
    apart = envs.make(Camera, apart=True, flatten=False)
    check_env_specs(apart)
    assert {k: x.dtype for k, x in apart.simulator.reset().items()} == {
        "image": torch.uint8, "speed": torch.float32, "ticks": torch.int64,
    }  # fmt: skip
    assert "image 'image' is flattened" not in caplog.text
    assert envs.make(Camera, apart=True).reset()["observation"].shape == (1, 51)
    assert "image 'image' is flattened with the rest: envs.make(..., flatten=False)" in caplog.text
    vector = envs.make(gym.vector.SyncVectorEnv([lambda: Camera(apart=True)] * 2), flatten=False)
    assert vector.simulator.reset()["image"].dtype == torch.uint8


def test_what_a_function_returns_decides_what_it_is():
    asked = []

    def make(num_envs: int, seed: int) -> EnvBase:
        asked.append((num_envs, seed))
        return SerialEnv(num_envs, lambda: GymEnv("Pendulum-v1"))

    env = envs.make(make, num_envs=3, seed=7)
    assert isinstance(env.simulator, envs.Torch) and asked == [(3, 7)] and env.batch_size == (3,)
    env = envs.make(lambda num_envs: gym.make_vec("CartPole-v1", num_envs=num_envs), 2, workers=2)
    assert isinstance(env.simulator, envs.GymnasiumVector) and env.observation_spec.shape == (2,)
    assert isinstance(envs.make(lambda seed: gym.make("CartPole-v1"), 2).simulator, envs.Gymnasium)
    one = envs.make(GymEnv("Pendulum-v1"))
    assert one.batch_size == (1,) and one.rollout(3).shape == (1, 3)
    with pytest.raises(UserError, match="made 2 environments where num_envs=3"):
        envs.make(lambda: TorchSteps(2), num_envs=3)
    for settings in ({"workers": 2}, {"gravity": 9}):
        with pytest.raises(UserError, match="give a function that makes one"):
            envs.make(TorchSteps(), **settings)
    for settings in ({"action_repeat": 2}, {"max_episode_steps": 9}):
        with pytest.raises(UserError, match="is for single Gymnasium environments"):
            envs.make(TorchSteps(), **settings)
    with pytest.raises(UserError, match="the TorchSteps given is 2"):
        envs.make(TorchSteps(), num_envs=4)


def test_spaces_and_wrappers_that_do_not_fit_are_named(caplog):
    class Mission(spaces.Space):
        """A space of another library."""

    class Spoken(Steps):
        observation_space = Mission()  # pyright: ignore[reportAssignmentType]

    class Lacking(Steps):
        observation_space = None  # pyright: ignore[reportAssignmentType]

    with pytest.raises(UserError, match="cannot become one vector"):
        envs.make(Spoken)
    with pytest.raises(UserError, match="Lacking.observation_space is missing, no gymnasium.spaces.Space"):
        envs.make(Lacking)
    envs.make(Steps)
    assert not caplog.text
    envs.make(lambda: gym.wrappers.TransformReward(gym.wrappers.NormalizeReward(Steps()), float))
    assert "NormalizeReward keeps statistics that evaluation and a resume begin anew" in caplog.text


def test_dm_control_objects_are_taken():
    from dm_control import suite

    env = envs.make(lambda: suite.load("cartpole", "swingup"), seed=1)
    assert torch.equal(env.reset()["observation"], envs.make("dmc:cartpole-swingup", seed=1).reset()["observation"])


def test_transforms_count_for_themselves():
    inner = TransformedEnv(TorchSteps(2), Compose(StepCounter(max_steps=2), RewardSum()))
    env = envs.make(inner)
    assert list(env.observation_spec.keys()) == ["observation", "is_success"]
    check_env_specs(env)
    env.simulator.reset()
    flags = [env.simulator.step({"action": torch.zeros(2, 1)}).truncated["truncated"].flatten().tolist() for _ in "12"]
    assert flags == [[False, False], [True, True]]
    env.simulator.step({"action": torch.full((2, 1), 9.0)})
    assert inner.base_env.seen.tolist() == [[1.0], [1.0]]  # clipped, as in every environment


def test_partial_resets_of_torchrl_reach_the_simulator():
    env = TransformedEnv(envs.make(lambda: Steps(9), num_envs=2, seed=1), StepCounter(max_steps=3))
    rollout = env.rollout(7, break_when_any_done=False)
    assert rollout["observation"][0].tolist() == [[1, 0], [1, 1], [1, 2], [2, 0], [2, 1], [2, 2], [3, 0]]
