from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from pgkit import envs, modules, run
from pgkit.errors import UserError


@pytest.fixture
def run_dir(kit: SimpleNamespace, tmp_path: Path) -> Path:
    args = kit.Args(env_id="Fake-v0", run_dir=tmp_path / "r", total_frames=20, eval_every=10)
    policy = kit.policy(weight=0.25)
    with run.Run(args, "walk") as log:
        log.track(policy=policy, eval_env=kit.Env)
        log.step(10)
        log.best = {"frames": 10, "eval/mean_reward": float("inf")}  # nothing after this is better
        torch.nn.init.constant_(policy.module.weight, 0.5)
        log.step(20)
    return tmp_path / "r"


def test_one_observation_or_a_batch(kit: SimpleNamespace, run_dir: Path):
    policy = run.load_policy(run_dir, "latest", agent=kit.agent)
    assert policy.frames == 20
    np.testing.assert_array_equal(policy.predict(np.array([0.5, 1.0])), [0.75])
    np.testing.assert_array_equal(policy.predict(np.array([[0.5, 1.0], [-0.5, 0.0]])), [[0.75], [-0.25]])


def test_actions_are_clipped_to_the_bounds(kit: SimpleNamespace, run_dir: Path):
    policy = run.load_policy(str(run_dir), "latest", agent=kit.agent)
    np.testing.assert_array_equal(policy.predict(np.array([[9.0, 9.0], [-9.0, 0.0]])), [[1.0], [-1.0]])


def test_best_and_latest_are_different_weights(kit: SimpleNamespace, run_dir: Path):
    obs = np.array([0.5, 0.5])
    assert run.load_policy(run_dir, "best", agent=kit.agent).predict(obs) == 0.25
    assert run.load_policy(run_dir, "latest", agent=kit.agent).predict(obs) == 0.5


def test_the_entries_of_a_dict():
    actor = TensorDictModule(lambda a, b: a.sum(-1, keepdim=True) + b, ["a", "b"], ["action"])
    policy = run.Policy(actor, lambda: None, {"a": (2,), "b": (1,)})
    np.testing.assert_array_equal(policy.predict({"a": np.array([1.0, 2.0]), "b": np.array([0.5])}), [3.5])
    np.testing.assert_array_equal(policy.predict({"a": np.ones((3, 2)), "b": np.ones((3, 1))}), [[3.0]] * 3)
    with pytest.raises(UserError, match="predict got a; the policy takes the entries a, b"):
        policy.predict({"a": np.ones(2)})


def test_a_wrong_shape_and_a_wrong_directory(kit: SimpleNamespace, run_dir: Path, tmp_path: Path):
    with pytest.raises(UserError, match=r"shape \[3\]; the policy takes \[2\]"):
        run.load_policy(run_dir, agent=kit.agent).predict(np.zeros(3))
    with pytest.raises(UserError, match="not a run directory"):
        run.load_policy(tmp_path)


def test_discrete_actions_begin_where_the_space_does():
    class Late(gym.Env):
        observation_space, action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(3, start=5)

    env = envs.make(Late)
    policy = run.Policy(modules.categorical_actor(env), lambda: None, **run.policy.describe_env(env))
    actions = policy.predict(np.random.default_rng(0).normal(size=(50, 2)) * 9)
    assert set(actions.tolist()) <= {5, 6, 7} and policy.predict(np.zeros(2)) in Late.action_space


@pytest.mark.fault(
    kind=10,
    injected="half-bounded, integer, float64 and binary actions",
    outcome="`predict` gives what the environment gets in training, by one converter",
)
@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Box(np.array([0.0, -np.inf], np.float32), np.array([np.inf, 1.0], np.float32)),
        gym.spaces.Box(0, 5, (2,), np.int64),
        gym.spaces.Box(-1, 1, (2,), np.float64),
        gym.spaces.MultiBinary(2),
    ],
)
def test_predict_gives_what_the_environment_gets_in_training(space: gym.Space):
    class Keeps(gym.Env):
        observation_space, action_space = gym.spaces.Box(-9, 9, (2,)), space

        def reset(self, *, seed=None, options=None):
            return np.ones(2, "f4"), {}

        def step(self, action):
            self.action = action
            return np.ones(2, "f4"), 0.0, False, False, {}

    env = envs.make(Keeps)
    env.simulator.reset()
    for value in (-9.3, 0.6, 9.7) if env.action_spec.dtype.is_floating_point else (0, 1):
        raw = torch.full((1, 2), value)
        actor = TensorDictModule(lambda obs, raw=raw: raw, ["observation"], ["action"])
        policy = run.Policy(actor, lambda: None, **run.policy.describe_env(env))
        predicted = policy.predict(np.ones(2))
        env.simulator.step({"action": raw})
        trained = env.simulator.envs[0].unwrapped.action
        assert predicted.dtype == trained.dtype == space.dtype
        assert predicted.tolist() == trained.tolist() and predicted in space
