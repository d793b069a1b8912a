"""The deterministic actor and the noise around it."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit import collectors, envs, modules
from pgkit.errors import UserError
from pgkit.run.evaluate import act


class Asymmetric(gym.Env):
    """Ends after three steps; both dimensions have bounds of their own."""

    observation_space = gym.spaces.Box(-1, 1, (3,))
    action_space = gym.spaces.Box(np.array([-1.0, 2.0], np.float32), np.array([3.0, 2.5], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.zeros(3, np.float32), 0.0, False, self.t == 3, {}


def test_bounds_are_reached_and_never_passed():
    torch.manual_seed(0)
    env = envs.make(Asymmetric)
    actor = modules.deterministic_actor(env, hidden=(8,))
    obs = TensorDict({"observation": torch.randn(500, 3)}, [500])
    start = actor(obs.copy())["action"]
    torch.testing.assert_close(start.mean(0), torch.tensor([1.0, 2.25]), atol=0.05, rtol=0)  # the middle
    with torch.no_grad():
        actor.get_parameter("module.1.0.weight").mul_(1e6)
    action = actor(obs.copy())["action"]
    torch.testing.assert_close(action.amin(0), torch.tensor([-1.0, 2.0]), atol=1e-5, rtol=0)
    torch.testing.assert_close(action.amax(0), torch.tensor([3.0, 2.5]), atol=1e-5, rtol=0)
    # low + (high - low) / 2 * (1 + tanh x) at x = 0.5: -1 + 2 * 1.4621172 and 2 + 0.25 * 1.4621172
    low, high = torch.tensor([-1.0, 2.0]), torch.tensor([3.0, 2.5])
    squashed = modules.deterministic.Squash(low, high)(torch.full((1, 2), 0.5))
    torch.testing.assert_close(squashed, torch.tensor([[1.9242343, 2.3655293]]))


def test_gaussian_noise_is_a_share_of_half_the_range_and_only_for_exploring():
    torch.manual_seed(0)
    env = envs.make(Asymmetric)
    actor = modules.deterministic_actor(env, hidden=(8,))
    exploring = modules.GaussianExploration(actor, env, std=0.1)
    obs = TensorDict({"observation": torch.zeros(20_000, 3)}, [20_000])
    mean = actor(obs.copy())["action"]
    with set_exploration_type(ExplorationType.RANDOM):
        noise = exploring(obs.copy())["action"] - mean
    torch.testing.assert_close(noise.std(0), torch.tensor([0.2, 0.025]), rtol=0.03, atol=0)
    torch.testing.assert_close(noise.mean(0), torch.zeros(2), atol=5e-3, rtol=0)
    for kind in (ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN):
        with set_exploration_type(kind):
            assert torch.equal(exploring(obs.copy())["action"], mean)
    exploring.std.fill_(100.0)
    with set_exploration_type(ExplorationType.RANDOM):
        action = exploring(obs.copy())["action"]
    assert torch.equal(action.amin(0), torch.tensor([-1.0, 2.0])) and torch.equal(
        action.amax(0), torch.tensor([3.0, 2.5])
    )


@pytest.mark.parametrize("compile", ["off", "on"])
def test_the_collector_explores_and_evaluation_does_not(compile):
    env = envs.make(Asymmetric, num_envs=4, seed=1)
    actor = modules.deterministic_actor(env, hidden=(8,))
    exploring = modules.GaussianExploration(actor, env, std=0.1)
    collector = collectors.VectorCollector(env, exploring, frames_per_batch=400, compile=compile)
    deviation = collector.rollout()["action"].flatten(0, 1).std(0)
    torch.testing.assert_close(deviation, torch.tensor([0.2, 0.025]), rtol=0.2, atol=0)
    exploring.std.fill_(0.0)  # takes effect though the policy was recorded
    assert collector.rollout()["action"].flatten(0, 1).std(0).max() < 1e-6
    exploring.std.fill_(0.1)
    obs = np.zeros((5, 3), np.float32)
    assert np.ptp(act(exploring, obs), axis=0).max() == 0


def test_ornstein_uhlenbeck_by_hand():
    # theta 0.25, sigma 0.5: n_1 = 0.5 e_1 (an episode begins), n_2 = 0.75 n_1 + 0.5 e_2; half the range is 2 and 0.25
    env = envs.make(Asymmetric, num_envs=2)
    actor = modules.deterministic_actor(env, hidden=(8,))
    exploring = modules.OrnsteinUhlenbeck(actor, env, std=0.5, theta=0.25)
    torch.manual_seed(0)
    first, second = torch.randn(2, 2), torch.randn(2, 2)
    obs, stale = torch.zeros(2, 3), torch.full((2, 2), 9.0)
    torch.manual_seed(0)
    begin = TensorDict({"observation": obs, "recurrent_state": stale, "is_init": torch.ones(2, 1).bool()}, [2])
    with set_exploration_type(ExplorationType.RANDOM):
        begin = exploring(begin)
        state = begin["next", "recurrent_state"]
        torch.testing.assert_close(state, 0.5 * first)
        after = TensorDict({"observation": obs, "recurrent_state": state, "is_init": torch.zeros(2, 1).bool()}, [2])
        after = exploring(after)
    noise = 0.75 * 0.5 * first + 0.5 * second
    torch.testing.assert_close(after["next", "recurrent_state"], noise)
    mean = actor(TensorDict({"observation": obs}, [2]))["action"]
    low, high, half = torch.tensor([-1.0, 2.0]), torch.tensor([3.0, 2.5]), torch.tensor([2.0, 0.25])
    torch.testing.assert_close(after["action"], (mean + half * noise).clamp(low, high))
    assert np.array_equal(act(exploring, obs.numpy()), mean.detach().numpy())  # deterministic: no state is needed


@pytest.mark.parametrize(("compile", "workers"), [("off", 1), ("on", 1), ("off", 2)])
def test_the_noise_is_carried_through_an_episode_across_rollouts_and_resumes(compile, workers):
    def collector(theta=0.15):
        torch.manual_seed(0)
        env = envs.make(Asymmetric, num_envs=2, seed=1, workers=workers)
        exploring = modules.OrnsteinUhlenbeck(modules.deterministic_actor(env, (8,)), env, std=0.2, theta=theta)
        return collectors.VectorCollector(env, exploring, frames_per_batch=2 * 2, compile=compile)

    source = collector()
    rollouts = [source.rollout() for _ in range(5)]
    noise = torch.cat([rollout["next", "recurrent_state"] for rollout in rollouts], 1)
    action = torch.cat([rollout["action"] for rollout in rollouts], 1)
    # episodes of 3 steps: n_0 = 0.2 e, n_1 = 0.85 n_0 + 0.2 e, n_2 = 0.85 n_1 + 0.2 e, then again from zero
    before = torch.cat([torch.zeros(2, 1, 2), noise[:, :-1]], 1)
    before[:, ::3] = 0.0
    draws = (noise - 0.85 * before) / 0.2
    torch.manual_seed(0)
    plain = collector(theta=1.0)  # forgets at once: its noise is the draws themselves
    expected = torch.cat([plain.rollout()["next", "recurrent_state"] for _ in range(5)], 1) / 0.2
    torch.testing.assert_close(draws, expected, atol=1e-5, rtol=0)
    mean = source.actor.actor(TensorDict({"observation": torch.zeros(3)}, []))["action"]
    inside = (mean + torch.tensor([2.0, 0.25]) * noise).clamp(torch.tensor([-1.0, 2.0]), torch.tensor([3.0, 2.5]))
    torch.testing.assert_close(action, inside)
    state = source.state_dict()
    resumed = collector()
    resumed.load_state_dict(state)
    again, straight = resumed.rollout(), source.rollout()
    assert torch.equal(again["action"], straight["action"])
    for each in (source, plain, resumed):
        each.shutdown()


def test_refusals():
    with pytest.raises(UserError, match=r"modules\.categorical_actor"):
        modules.deterministic_actor(envs.make("CartPole-v1"))


def test_noise_is_repeated_for_a_drawn_number_of_steps():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=4, seed=1)  # episodes of 200 steps, actions within 2
    actor = modules.tanh_normal_actor(env, (8,))
    exploring = modules.NoiseRepeat(actor, env, zeta=2.0, longest=4)
    torch.testing.assert_close(exploring.shares, torch.tensor([144, 180, 196, 205]) / 205)  # 1, 1/4, 1/9, 1/16
    rollout = collectors.VectorCollector(env, exploring, frames_per_batch=4 * 2_000, compile="off").rollout()
    state = rollout["next", "recurrent_state"]
    noise, left = state[..., 0], state[..., 1]
    out = actor(rollout.select("observation"))
    expected = 2 * (out["loc"] + out["scale"] * noise.unsqueeze(-1)).tanh()
    torch.testing.assert_close(rollout["action"], expected, atol=1e-5, rtol=0)
    drawn = torch.ones_like(noise, dtype=torch.bool)
    drawn[:, 1:] = noise[:, 1:] != noise[:, :-1]
    assert drawn[:, ::200].all()  # an episode begins
    assert (left[:, :-1][drawn[:, 1:] & ~_starts(drawn)] == 0).all()
    lengths = left[drawn] + 1
    shares = torch.stack([(lengths == n).float().mean() for n in (1, 2, 3, 4)])
    torch.testing.assert_close(shares, torch.tensor([144, 36, 16, 9]) / 205, atol=0.02, rtol=0)
    assert noise[drawn].mean().abs() < 0.05 and abs(noise[drawn].std() - 1) < 0.05
    obs = np.zeros((5, 3), np.float32)
    assert np.ptp(act(exploring, obs), axis=0).max() == 0


def _starts(drawn):
    starts = torch.zeros_like(drawn)
    starts[:, ::200] = True
    return starts[:, 1:]


@pytest.mark.parametrize("kind", [modules.GaussianExploration, modules.OrnsteinUhlenbeck, modules.NoiseRepeat])
def test_the_noise_is_made_where_the_actor_is(kind):
    """Which may be a GPU, for which the meta device stands here, and the environment on the CPU."""
    env = envs.make("Pendulum-v1")
    explorer = kind(modules.tanh_normal_actor(env, (8,), device="meta"), env)
    assert {x.device.type for x in explorer.buffers()} == {"meta"}
