"""The critic ensemble, and the squashed actor's bounds and log-probability."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob

from pgkit import envs, modules
from pgkit.errors import UserError


class Asymmetric(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (3,))
    action_space = gym.spaces.Box(np.array([-1.0, 2.0], np.float32), np.array([3.0, 2.5], np.float32))


def test_each_critic_is_a_perceptron_of_its_own():
    env = envs.make("Pendulum-v1")
    critics = modules.q_value(env, num_critics=3, hidden=(8, 8))
    batch = TensorDict({"observation": torch.randn(5, 3), "action": torch.randn(5, 1)}, [5])
    value = critics(batch)["state_action_value"]
    assert value.shape == (5, 3)
    x = torch.cat([batch["observation"], batch["action"]], -1)
    first, _, second, _, last = critics.module.layers
    for k in range(3):
        h = (x @ first.weight[k] + first.bias[k]).relu()
        h = (h @ second.weight[k] + second.bias[k]).relu()
        torch.testing.assert_close(value[:, k], (h @ last.weight[k] + last.bias[k]).squeeze(-1))
        assert torch.allclose(second.weight[k].T @ second.weight[k], 2 * torch.eye(8), atol=1e-5)  # orthogonal, gain √2
    assert not torch.allclose(first.weight[0], first.weight[1])


def test_any_batch_shape():
    critics = modules.q_value(envs.make("Pendulum-v1"), hidden=(8,))
    batch = TensorDict({"observation": torch.randn(4, 5, 3), "action": torch.randn(4, 5, 1)}, [4, 5])
    assert critics(batch)["state_action_value"].shape == (4, 5, 2)


def test_asymmetric_bounds_are_reached_and_never_passed():
    env = envs.make(Asymmetric)
    actor = modules.tanh_normal_actor(env, hidden=(8,), log_std_bounds=(2.0, 3.0))
    action = actor(TensorDict({"observation": torch.randn(5000, 3)}, [5000]))["action"]
    low, high = torch.tensor([-1.0, 2.0]), torch.tensor([3.0, 2.5])
    assert ((action >= low) & (action <= high)).all()
    torch.testing.assert_close(action.amin(0), low, atol=1e-3, rtol=0)
    torch.testing.assert_close(action.amax(0), high, atol=1e-3, rtol=0)


def test_log_probability_at_saturation_agrees_with_float64():
    loc, scale = torch.tensor([[20.0, -15.0], [3.0, 0.1]]), torch.tensor([[0.1, 2.0], [0.5, 1.0]])
    results = []
    for dtype in (torch.float32, torch.float64):
        torch.manual_seed(0)
        noise = torch.randn(2, 2)
        dist = TanhNormal(loc.to(dtype), scale.to(dtype), low=-2.0, high=2.0, event_dims=1)
        if dtype == torch.float32:
            torch.manual_seed(0)
            log_prob = rsample_and_log_prob(dist)[1]
        # log N(u) - sum log(2 (1 - tanh² u)), with 1 - tanh² u = 4 e^(-2|u|) / (1 + e^(-2|u|))²
        u = loc.double() + scale.double() * noise.double()
        jacobian = np.log(2) + np.log(4) - 2 * u.abs() - 2 * torch.log1p(torch.exp(-2 * u.abs()))
        normal = -0.5 * noise.double() ** 2 - scale.double().log() - 0.5 * np.log(2 * np.pi)
        results.append((normal - jacobian).sum(-1))
    torch.testing.assert_close(log_prob.double(), results[1], rtol=1e-5, atol=1e-4)


def test_a_discrete_or_unbounded_action_is_refused():
    with pytest.raises(UserError, match=r"modules\.categorical_actor"):
        modules.tanh_normal_actor(envs.make("CartPole-v1"))

    class Unbounded(Asymmetric):
        action_space = gym.spaces.Box(-np.inf, np.inf, (2,))

    with pytest.raises(UserError, match="no bounds"):
        modules.tanh_normal_actor(envs.make(Unbounded))


def test_each_discrete_critic_is_a_perceptron_of_its_own_with_a_value_for_every_action():
    env = envs.make("Acrobot-v1")
    critics = modules.discrete_q_value(env, num_critics=3, hidden=(8,))
    obs = torch.randn(5, 6)
    value = critics(TensorDict({"observation": obs}, [5]))["action_value"]
    assert value.shape == (5, 3, 3)
    first, _, last = critics.module.layers
    for k in range(3):
        h = (obs @ first.weight[k] + first.bias[k]).relu()
        torch.testing.assert_close(value[:, k], h @ last.weight[k] + last.bias[k])
    assert not torch.allclose(first.weight[0], first.weight[1])


def test_any_batch_shape_of_discrete_critics():
    critics = modules.discrete_q_value(envs.make("CartPole-v1"), hidden=(8,))
    obs = torch.randn(4, 5, 4)
    value = critics(TensorDict({"observation": obs}, [4, 5]))["action_value"]
    flat = critics(TensorDict({"observation": obs.reshape(20, 4)}, [20]))["action_value"]
    torch.testing.assert_close(value, flat.reshape(4, 5, 2, 2))
