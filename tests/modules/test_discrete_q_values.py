import torch
from tensordict import TensorDict

from pgkit import envs, modules


def test_each_critic_is_a_perceptron_of_its_own_with_a_value_for_every_action():
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


def test_any_batch_shape():
    critics = modules.discrete_q_value(envs.make("CartPole-v1"), hidden=(8,))
    obs = torch.randn(4, 5, 4)
    value = critics(TensorDict({"observation": obs}, [4, 5]))["action_value"]
    flat = critics(TensorDict({"observation": obs.reshape(20, 4)}, [20]))["action_value"]
    torch.testing.assert_close(value, flat.reshape(4, 5, 2, 2))
