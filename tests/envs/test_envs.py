from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from torchrl.envs.utils import check_env_specs

from pgkit import envs
from pgkit.errors import UserError


class Counter(gym.Env):
    """Observation: steps since reset; terminates after 3 steps, or is truncated after 5 if ``endless``."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space = spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, 5.0], np.float32))

    def __init__(self, endless=False):
        self.endless = endless

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.start = 0, self.np_random.random()
        return np.array([self.start]), {}

    def step(self, action):
        self.t += 1
        self.action = action
        obs = np.array([self.start + self.t])
        return obs, 2.0, not self.endless and self.t == 3, self.endless and self.t == 5, {}


def test_same_step_autoreset_keeps_the_final_observation():
    arrays = envs.make(Counter, num_envs=2, seed=3).arrays
    first = arrays.reset().copy()
    action = np.zeros((2, 2), np.float32)
    for t in (1, 2, 3):
        next_obs, reward, terminated, truncated = arrays.step(action)
        np.testing.assert_allclose(next_obs, first + t, rtol=1e-6)
        assert reward.tolist() == [2.0, 2.0] and not truncated.any()
        assert terminated.all() == (t == 3)
        assert arrays.episode_reward.tolist() == [2.0 * t] * 2 and arrays.step_count.tolist() == [t, t]
    assert (arrays.obs != next_obs).all() and (arrays.obs < 1).all()  # the next episode's first
    arrays.step(action)
    assert arrays.episode_reward.tolist() == [2.0, 2.0] and arrays.step_count.tolist() == [1, 1]


def test_truncation_is_not_termination():
    arrays = envs.make(lambda: Counter(endless=True), num_envs=1).arrays
    arrays.reset()
    flags = [tuple(x[0] for x in arrays.step(np.zeros((1, 2), np.float32))[2:]) for _ in range(5)]
    assert flags == [(False, False)] * 4 + [(False, True)]


def test_actions_are_clipped_to_asymmetric_bounds():
    arrays = envs.make(Counter, num_envs=1).arrays
    arrays.reset()
    arrays.step(np.array([[-9.0, -9.0]], np.float32))
    assert arrays.envs[0].unwrapped.action.tolist() == [-1.0, 0.0]
    arrays.step(np.array([[9.0, 9.0]], np.float32))
    assert arrays.envs[0].unwrapped.action.tolist() == [1.0, 5.0]


def test_every_env_has_its_own_stream_and_the_seed_decides():
    def obs(seed):
        return envs.make("Pendulum-v1", num_envs=3, seed=seed).arrays.reset().copy()

    assert len(np.unique(obs(1)[:, 0])) == 3
    assert np.array_equal(obs(1), obs(1)) and not np.array_equal(obs(1), obs(2))
    env = envs.make("Pendulum-v1", num_envs=3, seed=1)
    env.arrays.reset()
    env.arrays.step(np.zeros((3, 1), np.float32))
    env.set_seed(2)
    assert np.array_equal(env.arrays.reset(), obs(2))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "HalfCheetah-v5", "dm_control/cheetah-run-v0"])
def test_state_replays_bit_for_bit(env_id):
    def play(env, steps, rng):
        out = [env.arrays.obs.copy()]
        for _ in range(steps):
            shape = env.action_spec.shape
            action = rng.integers(2, size=shape) if env_id == "CartPole-v1" else rng.uniform(-1, 1, shape)
            out += [x.copy() for x in env.arrays.step(action.astype(np.float32) if len(shape) > 1 else action)]
            out += [env.arrays.obs.copy(), env.arrays.episode_reward.copy()]
        return out

    env = envs.make(env_id, num_envs=2, seed=7)
    env.arrays.reset()
    play(env, 30, np.random.default_rng(0))
    again = envs.make(env_id, num_envs=2, seed=7)
    again.arrays.load_state_dict(env.arrays.state_dict())
    a, b = (play(e, 40, np.random.default_rng(1)) for e in (env, again))
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1", "dmc:cartpole-swingup"])
def test_torchrl_accepts_the_env(env_id):
    check_env_specs(envs.make(env_id, num_envs=3))


def test_dm_control_time_limit_truncates():
    env = envs.make("dm_control/cartpole-swingup-v0", num_envs=1)
    env.arrays.reset()
    for _ in range(1000):
        _, _, terminated, truncated = env.arrays.step(np.zeros((1, 1), np.float32))
    assert truncated.all() and not terminated.any()


def test_dict_observations_are_flattened_in_the_order_of_the_space():
    class Two(Counter):
        observation_space = spaces.Dict({"a": spaces.Box(-9, 9, (2,)), "b": spaces.Box(-9, 9, ())})

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return {"b": np.float64(3.0), "a": np.array([1.0, 2.0])}, {}

    env = envs.make(Two)
    assert env.observation_spec_unbatched["observation"].shape == (3,)
    obs = env.arrays.reset()
    assert obs.tolist() == [[1.0, 2.0, 3.0]] and obs.dtype == np.float32


def test_a_discrete_space_may_start_elsewhere():
    class Shifted(Counter):
        action_space = spaces.Discrete(2, start=5)

    arrays = envs.make(Shifted).arrays
    arrays.reset()
    arrays.step(np.array([1]))
    assert arrays.envs[0].unwrapped.action == 6


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("HalfCheeta-v5", "unknown environment id 'HalfCheeta-v5'; the nearest names are HalfCheetah-v5"),
        ("dm_control/cheetah-fly-v0", "nearest names are dm_control/cheetah-run-v0"),
        ("HalfCheetah-v99", "unknown environment id 'HalfCheetah-v99'; the nearest names are HalfCheetah-v5"),
        ("HalfCheetah-v3", "one of Gymnasium's former ones: use HalfCheetah-v5"),
        ("", "environment '': Malformed environment ID"),
        ("no_such_module:Walk-v0", "no module 'no_such_module' to import"),
    ],
)
def test_unknown_ids(env_id, message):
    with pytest.raises(UserError, match=message):
        envs.make(env_id)


def test_missing_package_names_the_install_line(monkeypatch):
    def missing(*args, **kwargs):
        raise gym.error.DependencyNotInstalled("Box2D is not installed")

    monkeypatch.setattr(gym, "make", missing)
    with pytest.raises(UserError, match=r'pip install "gymnasium\[box2d\]"'):
        envs.make("LunarLander-v3")


def test_more_workers_than_envs():
    with pytest.raises(UserError, match="every worker needs at least one environment"):
        envs.make("CartPole-v1", num_envs=2, workers=3)


class Own(gym.Env):
    """Three numbers; what ``reset`` and ``step`` return can be made wrong."""

    def __init__(self, level: int = 1, obs: Any = (1, 2, 3), end: bool = False, wrong: str = "") -> None:
        self.level, self.obs, self.end, self.wrong = level, np.array(obs, np.float32), end, wrong
        self.observation_space, self.action_space = gym.spaces.Box(-9, 9, (3,)), gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.obs * self.level if self.wrong == "reset" else (self.obs * self.level, {})

    def step(self, action: Any) -> Any:
        obs = self.obs[:1] if self.wrong == "obs" else self.obs
        reward = np.ones(3) if self.wrong == "reward" else 1.0
        return (obs, reward, False, {}) if self.wrong == "step" else (obs, reward, self.end, False, {})


def test_a_state_in_which_one_episode_has_just_begun_is_restored():
    env, twin = (envs.make(Own, num_envs=2, max_episode_steps=4).arrays for _ in range(2))
    env.reset()
    env.step(np.zeros((2, 1)))
    env.fresh[:] = [False, True]
    env._begin(1)  # the second begins again
    twin.load_state_dict(env.state_dict())
    assert [len(x) for x in twin.state_dict()["history"]] == [1, 0]
    for _ in range(4):
        flags = [arrays.step(np.zeros((2, 1)))[3].tolist() for arrays in (env, twin)]
        assert flags[0] == flags[1]
    for _ in range(50):
        env.step(np.zeros((2, 1)))
    assert len(env._taken) < 10  # what is over is let go


def test_keywords_and_a_time_limit_reach_a_class():
    env = envs.make(Own, num_envs=2, level=2, max_episode_steps=3)
    assert env.reset()["observation"].tolist() == [[2, 4, 6]] * 2
    rollout = env.rollout(7, break_when_any_done=False, auto_reset=True)
    assert rollout["next", "truncated"].squeeze(-1).tolist() == [[False, False, True, False, False, True, False]] * 2
    assert (
        envs.make("dm_control/cartpole-swingup-v0", max_episode_steps=4).rollout(9)["next", "truncated"].shape[1] == 4
    )
    with pytest.raises(TypeError, match="typo"):
        envs.make(Own, typo=3)
    with pytest.raises(UserError, match="'Pendulum-v1' cannot be made with these settings: .*'gravty'"):
        envs.make("Pendulum-v1", gravty=9)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("reset", r"Own.reset returned a ndarray: return the tuple \(observation, info\)"),
        ("step", "Own.step returned a tuple of 4: return the tuple .*truncated, info"),
        ("obs", r"Own.step returned observation of shape \(1,\), its space says \(3,\)"),
        ("reward", r"Own.step returned a reward of shape \(3,\): return one number"),
    ],
)
def test_what_an_environment_of_ones_own_returns_is_checked_once(wrong, message):
    with pytest.raises(UserError, match=message):
        envs.make(Own, num_envs=2, wrong=wrong).rollout(2)


def test_former_gym_s_reset_and_missing_entries_are_named():
    class Former(Own):
        def reset(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
            return self.obs

    class Lacking(Own):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = gym.spaces.Dict(a=gym.spaces.Box(-9, 9, (3,)), b=gym.spaces.Box(-9, 9, (3,)))

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return {"a": self.obs}, {}

    with pytest.raises(UserError, match="Former.reset takes no seed: write reset"):
        envs.make(Former).reset()
    with pytest.raises(UserError, match=r"Lacking.reset returned no observation\['b'\]"):
        envs.make(Lacking).reset()


def test_an_environment_is_no_maker_of_environments():
    one = gym.make("Pendulum-v1")
    for env in (one, envs.make("Pendulum-v1"), None):
        with pytest.raises(UserError, match=f"takes an id, or a function or class .* this is a {type(env).__name__}"):
            envs.make(env)
    with pytest.raises(UserError, match="gave the same one twice"):
        envs.make(lambda: one, num_envs=2).reset()


def test_actions_of_an_integer_box_are_rounded():
    class Integers(Counter):
        action_space = spaces.Box(0, 5, (2,), np.int64)

    arrays = envs.make(Integers, seed=1).arrays
    arrays.reset()
    arrays.step(np.array([[1.7, 9.0]], np.float32))
    action = arrays.envs[0].unwrapped.action
    assert action.dtype == np.int64
    assert action.tolist() == [2, 5]


def test_an_action_that_is_nan_is_not_the_environment_s_fault():
    arrays = envs.make("Pendulum-v1", seed=1).arrays
    arrays.reset()
    with pytest.raises(UserError, match="the policy's action is"):
        arrays.step(np.array([[np.nan]], np.float32))


def test_a_seed_that_is_none_is_refused():
    with pytest.raises(UserError, match="seed=None: give a whole number"):
        envs.make("Pendulum-v1", seed=None)  # pyright: ignore[reportArgumentType]
