from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs.utils import check_env_specs

from pgkit import envs
from pgkit.errors import UserError


def step(simulator, actions):
    """Next observation, reward and flags as arrays ``[N, ...]``."""
    made = simulator.step({"action": torch.as_tensor(np.asarray(actions))})
    flags = made.terminated["terminated"], made.truncated["truncated"]
    return (made.next["observation"].numpy(), *(x.numpy()[:, 0] for x in (made.reward["reward"], *flags)))


def first(simulator):
    return simulator.reset()["observation"].numpy()


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
    simulator = envs.make(Counter, num_envs=2, seed=3).simulator
    begin = first(simulator).copy()
    action = np.zeros((2, 2), np.float32)
    for t in (1, 2, 3):
        made = simulator.step({"action": torch.from_numpy(action)})
        np.testing.assert_allclose(made.next["observation"], begin + t, rtol=1e-6)
        assert made.reward["reward"].tolist() == [[2.0], [2.0]] and not made.truncated["truncated"].any()
        assert made.terminated["terminated"].all() == made.ended().all() == made.begun().all() == (t == 3)
        assert simulator.episode_reward["reward"].tolist() == [[2.0 * t]] * 2
        assert simulator.step_count.tolist() == [t, t]
    fresh = made.fresh["observation"]
    assert (fresh != made.next["observation"]).all() and (fresh < 1).all()  # the next episode's first
    step(simulator, action)
    assert simulator.episode_reward["reward"].tolist() == [[2.0], [2.0]] and simulator.step_count.tolist() == [1, 1]


def test_truncation_is_not_termination():
    simulator = envs.make(lambda: Counter(endless=True), num_envs=1).simulator
    simulator.reset()
    flags = [tuple(x[0] for x in step(simulator, np.zeros((1, 2), np.float32))[2:]) for _ in range(5)]
    assert flags == [(False, False)] * 4 + [(False, True)]


def test_actions_are_clipped_to_asymmetric_bounds():
    simulator = envs.make(Counter, num_envs=1).simulator
    simulator.reset()
    step(simulator, np.array([[-9.0, -9.0]], np.float32))
    assert simulator.envs[0].unwrapped.action.tolist() == [-1.0, 0.0]
    step(simulator, np.array([[9.0, 9.0]], np.float32))
    assert simulator.envs[0].unwrapped.action.tolist() == [1.0, 5.0]


def test_every_env_has_its_own_stream_and_the_seed_decides():
    def obs(seed):
        return first(envs.make("Pendulum-v1", num_envs=3, seed=seed).simulator).copy()

    assert len(np.unique(obs(1)[:, 0])) == 3
    assert np.array_equal(obs(1), obs(1)) and not np.array_equal(obs(1), obs(2))
    env = envs.make("Pendulum-v1", num_envs=3, seed=1)
    env.simulator.reset()
    step(env.simulator, np.zeros((3, 1), np.float32))
    env.set_seed(2)
    assert np.array_equal(first(env.simulator), obs(2))
    assert np.array_equal(env.reset(seed=1)["observation"], obs(1))
    with pytest.raises(UserError, match=r"reset\(options=...\): the environments take a seed only"):
        env.reset(options={"level": 1})


def test_seeds_fit_a_signed_int():
    class Signed(Counter):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=int(np.int32(seed)))

    simulator = envs.make(Signed, num_envs=2, seed=2**40).simulator
    simulator.reset()
    for _ in range(60):
        step(simulator, np.zeros((2, 2), np.float32))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "HalfCheetah-v5", "dm_control/cheetah-run-v0"])
def test_state_replays_bit_for_bit(env_id):
    def play(env, steps, rng):
        out = []
        for _ in range(steps):
            shape = env.action_spec.shape
            action = rng.integers(2, size=shape) if env_id == "CartPole-v1" else rng.uniform(-1, 1, shape)
            made = env.simulator.step({"action": torch.as_tensor(action).to(env.action_spec.dtype)})
            tensors = [made.next, made.reward, made.terminated, made.truncated, made.fresh]
            out += [x.clone() for entries in tensors for x in entries.values()]
            out += [env.simulator.episode_reward["reward"].clone(), env.simulator.step_count.clone()]
        return out

    env = envs.make(env_id, num_envs=2, seed=7)
    env.simulator.reset()
    now = play(env, 30, np.random.default_rng(0))[-3]
    again = envs.make(env_id, num_envs=2, seed=7)
    assert torch.equal(again.simulator.load_state_dict(env.simulator.state_dict())["observation"], now)
    a, b = (play(e, 40, np.random.default_rng(1)) for e in (env, again))
    assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1", "dmc:cartpole-swingup"])
def test_torchrl_accepts_the_env(env_id):
    check_env_specs(envs.make(env_id, num_envs=3))


def test_dm_control_time_limit_truncates():
    env = envs.make("dm_control/cartpole-swingup-v0", num_envs=1)
    env.simulator.reset()
    for _ in range(1000):
        _, _, terminated, truncated = step(env.simulator, np.zeros((1, 1), np.float32))
    assert truncated.all() and not terminated.any()


def test_dict_observations_are_flattened_in_the_order_of_the_space():
    class Two(Counter):
        observation_space = spaces.Dict({"a": spaces.Box(-9, 9, (2,)), "b": spaces.Box(-9, 9, ())})

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return {"b": np.float64(3.0), "a": np.array([1.0, 2.0])}, {}

    env = envs.make(Two)
    assert env.observation_spec_unbatched["observation"].shape == (3,)
    obs = first(env.simulator)
    assert obs.tolist() == [[1.0, 2.0, 3.0]] and obs.dtype == np.float32


def test_a_discrete_space_may_start_elsewhere():
    class Shifted(Counter):
        action_space = spaces.Discrete(2, start=5)

    simulator = envs.make(Shifted).simulator
    simulator.reset()
    step(simulator, np.array([1]))
    assert simulator.envs[0].unwrapped.action == 6


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
    env, twin = (envs.make(Own, num_envs=2, max_episode_steps=4).simulator for _ in range(2))
    env.reset()
    step(env, np.zeros((2, 1), np.float32))
    env.reset(rows=torch.tensor([False, True]))  # the second begins again
    twin.load_state_dict(env.state_dict())
    assert [len(row["actions"]) for row in twin.state_dict()["rows"]] == [1, 0]
    for _ in range(4):
        flags = [step(simulator, np.zeros((2, 1), np.float32))[3].tolist() for simulator in (env, twin)]
        assert flags[0] == flags[1]
    for _ in range(50):
        step(env, np.zeros((2, 1), np.float32))
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
        ("obs", r"Own.step returned an observation .*: shape \(1,\), its space says \(3,\)"),
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
    with pytest.raises(UserError, match=r"Lacking.reset returned .* the entry 'b' is missing"):
        envs.make(Lacking).reset()


def test_an_environment_is_no_maker_of_environments():
    one = gym.make("Pendulum-v1")
    for env in (one, None):
        with pytest.raises(UserError, match=f"takes an id, a function or class .* this is a {type(env).__name__}"):
            envs.make(env)
    with pytest.raises(UserError, match="was given what envs.make gives"):
        envs.make(envs.make("Pendulum-v1"))
    with pytest.raises(UserError, match="made a NoneType: it must make a gym.Env"):
        envs.make(lambda: None)
    with pytest.raises(UserError, match="gave the same one twice"):
        envs.make(lambda: one, num_envs=2).reset()


def test_actions_of_an_integer_box_are_rounded():
    class Integers(Counter):
        action_space = spaces.Box(0, 5, (2,), np.int64)

    simulator = envs.make(Integers, seed=1).simulator
    simulator.reset()
    step(simulator, np.array([[1.7, 9.0]], np.float32))
    action = simulator.envs[0].unwrapped.action
    assert action.dtype == np.int64
    assert action.tolist() == [2, 5]


def test_an_action_that_is_nan_is_not_the_environment_s_fault():
    simulator = envs.make("Pendulum-v1", seed=1).simulator
    simulator.reset()
    with pytest.raises(UserError, match="the policy's action is"):
        step(simulator, np.array([[np.nan]], np.float32))


def test_a_seed_that_is_none_is_refused():
    with pytest.raises(UserError, match="seed=None: give a whole number"):
        envs.make("Pendulum-v1", seed=None)  # pyright: ignore[reportArgumentType]


def test_an_environment_that_changes_its_action_does_not_change_the_history():
    class Halves(Counter):
        def step(self, action):
            action *= 0.5
            self.start += action.sum()
            return super().step(action)

    env, twin = (envs.make(lambda: Halves(endless=True), seed=1).simulator for _ in range(2))
    env.reset()
    for _ in range(3):
        obs = step(env, np.ones((1, 2), np.float32))[0]
    assert twin.load_state_dict(env.state_dict())["observation"].numpy() == obs


@pytest.mark.parametrize("what", ["shape", "None", "flag", "reward", "reset"])
def test_what_is_wrong_later_is_named_too(what):
    class Late(Own):
        steps = resets = 0

        def reset(self, *, seed=None, options=None):
            self.resets += 1
            return (np.ones(2), {}) if what == "reset" and self.resets == 2 else (self.obs, {})

        def step(self, action):
            self.steps += 1
            obs, reward, terminated, truncated, info = super().step(action)
            late = self.steps > 3
            obs = {"shape": np.ones(1), "None": None}.get(what, obs) if late else obs
            reward = "5" if late and what == "reward" else reward
            terminated = "False" if late and what == "flag" else self.steps % 2 == 0
            return obs, reward, terminated, truncated, info

    simulator = envs.make(Late, num_envs=2).simulator
    message = {
        "shape": r"Late.step returned an observation .* shape \(1,\), its space says \(3,\)",
        "None": r"Late.step returned an observation .* shape \(\), its space says \(3,\)",
        "flag": "Late.step returned terminated='False': return True or False",
        "reward": "Late.step returned a reward '5': return a number",
        "reset": r"Late.reset returned an observation .*: shape \(2,\), its space says \(3,\)",
    }[what]
    simulator.reset()
    with pytest.raises(UserError, match=message):
        for _ in range(6):
            step(simulator, np.zeros((2, 1), np.float32))
