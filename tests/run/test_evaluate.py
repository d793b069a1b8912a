import random
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule, TensorDictSequential
from torch.distributions import Normal
from torchrl.envs import RewardScaling, TransformedEnv

from pgkit import envs, modules, run


class NoisyPolicy(torch.nn.Module):
    """Draws from the global generators, and remembers in which mode it was called."""

    def forward(self, td: TensorDict) -> TensorDict:
        _ = random.random(), np.random.rand()
        self.seen_training = self.training
        return td.set("action", torch.rand(*td.batch_size, 1))


def test_every_slot_plays_its_own_share(kit: SimpleNamespace):
    # 3 slots with episodes of 1, 2 and 3 steps; rewards a step are the episode's number + the seed, 1.
    # Of 5 episodes the slots 0 and 1 play two, slot 2 one. Taking the first five to finish would give
    # slot 0 (length 1) three of them.
    returns, lengths = run.play(kit.policy(), kit.Env(num_envs=3, seed=1), episodes=5)
    assert lengths.tolist() == [1, 1, 2, 2, 3]
    assert returns.tolist() == [1, 2, 2, 4, 3]


@pytest.mark.fault(
    kind=12, injected="evaluation of an environment that never ends", outcome="ended at a limit, counted, a warning"
)
def test_an_episode_that_goes_on_and_on_is_ended_and_counts(caplog: pytest.LogCaptureFixture):
    class Every5th(gym.Env):  # its first episode has no end, the second one has 5 steps, and so on
        observation_space, action_space = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Box(-1, 1, (1,))
        episode = 0

        def reset(self, *, seed=None, options=None):
            self.episode, self.steps = self.episode + 1, 0
            return np.zeros(2, np.float32), {}

        def step(self, action):
            self.steps += 1
            return np.zeros(2, np.float32), 1.0, self.episode % 2 == 0 and self.steps == 5, False, {}

    env = envs.make(Every5th, 2)
    returns, lengths = run.play(NoisyPolicy(), env, episodes=5, longest=9)
    assert lengths.tolist() == [9, 5, 9, 9, 5] and returns.tolist() == lengths.tolist()
    assert "an episode of evaluation was ended at 9 steps and counts as it is" in caplog.text


def test_scores_are_mean_and_population_deviation(kit: SimpleNamespace):
    scores = run.evaluate(kit.policy(), kit.Env(num_envs=2, seed=1), episodes=2)
    # returns 1 and 2
    assert scores == {"eval/mean_reward": 1.5, "eval/std_reward": 0.5, "eval/mean_ep_length": 1.5}


def test_global_generators_and_mode_are_left_alone(kit: SimpleNamespace):
    policy, env = NoisyPolicy(), kit.Env(num_envs=2, seed=0)
    before = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state()  # pyright: ignore
    run.play(policy, env, episodes=4)
    assert random.getstate() == before[0]
    assert np.random.get_state()[1].tolist() == before[1]  # pyright: ignore
    assert torch.equal(torch.get_rng_state(), before[2])
    assert policy.training and not policy.seen_training


def test_actions_are_deterministic(kit: SimpleNamespace):
    net = TensorDictModule(
        lambda obs: (obs.sum(-1, keepdim=True) + 0.25, torch.ones(len(obs), 1)),
        ["observation"],
        ["loc", "scale"],
    )
    sample = ProbabilisticTensorDictModule(["loc", "scale"], ["action"], distribution_class=Normal)
    env = kit.Env(num_envs=2, seed=0)
    run.play(TensorDictSequential([net, sample]), env, episodes=2)
    assert all((action == 0.25).all() for action in env.simulator.actions)


def test_an_environment_with_transforms_is_played_with_them():
    env = envs.make("Pendulum-v1", num_envs=2, max_episode_steps=4)
    actor = modules.gaussian_actor(env)
    plain, lengths = run.play(actor, envs.make("Pendulum-v1", num_envs=2, seed=3, max_episode_steps=4), episodes=2)
    inner = envs.make("Pendulum-v1", num_envs=2, max_episode_steps=4)
    scaled = envs.make(TransformedEnv(inner, RewardScaling(0, 10.0)), seed=3)
    returns, again = run.play(actor, scaled, episodes=2)
    np.testing.assert_allclose(returns, 10 * plain, rtol=1e-6)
    assert lengths.tolist() == again.tolist() == [4, 4]


def test_draws_are_evaluated_on_request():
    env = envs.make("Pendulum-v1", 2, seed=1)
    actor = modules.gaussian_actor(env, log_std=0.5)
    env.set_seed(1)
    first = run.evaluate(actor, env, 2)["eval/mean_reward"]
    env.set_seed(1)
    assert run.evaluate(actor, env, 2)["eval/mean_reward"] == first
    env.set_seed(1)
    assert run.evaluate(actor, env, 2, deterministic=False)["eval/mean_reward"] != first


def test_a_loaded_policy_is_evaluated_as_its_actor():
    env = envs.make("Pendulum-v1", 2, seed=1)
    actor = modules.gaussian_actor(env)
    policy = run.Policy(actor, envs.make, (3,))
    env.set_seed(1)
    expected = run.evaluate(actor, env, 2)
    env.set_seed(1)
    assert run.evaluate(policy, env, 2) == expected
