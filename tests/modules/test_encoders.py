import gymnasium as gym
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import GymEnv

from pgkit import collectors, controllers, data, envs, losses, modules, updates
from pgkit.errors import UserError
from tests.envs.test_layout import Sensors


def encoder():
    picture = nn.Sequential(nn.Conv2d(1, 2, 3), nn.ReLU(), nn.Flatten(), nn.Linear(8, 5))
    return modules.dict_encoder({"picture": picture, "speed": modules.mlp(2, None, (7,))})


def test_each_entry_has_its_own_encoder():
    torch.manual_seed(0)
    env = envs.make(Sensors, num_envs=3, seed=1, flatten=False)
    both = encoder()
    actor, critic = modules.gaussian_actor(env, encoder=both), modules.state_value(env, encoder=both)
    assert actor.in_keys == critic.in_keys == ["picture", "speed"]
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=30, compile="off").rollout()
    features = both(rollout["picture"].flatten(0, 1), rollout["speed"].flatten(0, 1))
    assert features.shape == (30, 12)
    torch.testing.assert_close(features[:, 5:], both.encoders[1](rollout["speed"].flatten(0, 1)))
    loc = actor.get_dist(rollout.reshape(-1)).base_dist.loc
    torch.testing.assert_close(loc, actor.get_submodule("module.0.module.head").mean(features))
    grads = torch.autograd.grad(critic(rollout.reshape(-1))["state_value"].sum(), both.parameters())
    assert all(grad.abs().sum() > 0 for grad in grads)


def test_torchrls_environments_have_such_entries_too():
    env = GymEnv("CartPole-v1")
    both = modules.dict_encoder({"observation": modules.mlp(4, None, (7,))})
    assert modules.categorical_actor(env, encoder=both)(env.reset())["logits"].shape == (2,)


def test_what_is_missing_is_named():
    env = envs.make(Sensors, num_envs=2, flatten=False)
    with pytest.raises(UserError, match=r"no observation 'observation', only picture, speed: .*dict_encoder"):
        modules.gaussian_actor(env)
    with pytest.raises(UserError, match="no observation 'sound', only picture, speed"):
        modules.gaussian_actor(env, encoder=modules.dict_encoder({"sound": nn.Identity()}))
    with pytest.raises(UserError, match="put normalizers into the encoders"):
        modules.gaussian_actor(env, encoder=encoder(), normalizer=modules.ObsNormalizer((2,)))
    flat = envs.make(Sensors, num_envs=2)
    with pytest.raises(UserError, match=r"the actor reads 'picture', the environment observes observation: .*flat"):
        collectors.VectorCollector(flat, modules.gaussian_actor(env, encoder=encoder()), frames_per_batch=4)


def test_a_deterministic_actor_reads_the_entries_of_its_encoder():
    env = envs.make(Sensors, num_envs=3, seed=1, flatten=False)
    actor = modules.deterministic_actor(env, encoder=encoder())
    assert actor.in_keys == ["picture", "speed"]
    assert actor(env.reset())["action"].shape == env.action_spec.shape


class Choose(Sensors):
    action_space = gym.spaces.Discrete(3)


@pytest.mark.parametrize("discrete", [False, True])
def test_critics_read_the_entries_of_their_encoder(discrete):
    env = envs.make(Choose if discrete else Sensors, num_envs=3, seed=1, flatten=False)
    both = encoder()
    build = modules.discrete_q_value if discrete else modules.q_value
    critics = build(env, 3, (8,), encoder=both)
    assert critics.in_keys == ["picture", "speed", *([] if discrete else ["action"])]
    batch = env.rollout(4).reshape(-1)
    features = both(batch["picture"], batch["speed"])
    x = features if discrete else torch.cat([features, batch["action"]], -1)
    first, _, last = critics.module.layers
    for k in range(3):
        value = (x @ first.weight[k] + first.bias[k]).relu() @ last.weight[k] + last.bias[k]
        torch.testing.assert_close(critics(batch)[critics.out_keys[0]][:, k], value if discrete else value.squeeze(-1))
    some = torch.tensor([2, 0])
    params = critics.members(TensorDict.from_module(critics), some)
    with params.to_module(critics):
        picked = critics(batch.clone())[critics.out_keys[0]]
    torch.testing.assert_close(picked, critics(batch)[critics.out_keys[0]][:, some])


@pytest.mark.parametrize("discrete", [False, True])
def test_soft_actor_critic_on_entries(discrete):
    torch.manual_seed(0)
    env = envs.make(Choose if discrete else Sensors, num_envs=2, seed=1, flatten=False)
    make_actor = modules.categorical_actor if discrete else modules.tanh_normal_actor
    actor = make_actor(env, encoder=encoder())
    critics = (modules.discrete_q_value if discrete else modules.q_value)(env, 3, (16,), encoder=encoder())
    make_loss = losses.DiscreteSACLoss if discrete else losses.SACLoss
    loss = make_loss(actor, critics, subset=2, gamma=0.5, temperature=controllers.FixedTemperature(0.01))
    update = updates.OffPolicyUpdate(
        loss, data.ReplayBuffer(env, 1000), torch.optim.Adam(loss.parameters(), 1e-2),
        batch_size=32, learning_starts=64, compile="off",
    )  # fmt: skip
    before = {name: x.clone() for name, x in loss.named_parameters()}
    for rollout in collectors.VectorCollector(env, actor, frames_per_batch=16, total_frames=160, compile="off"):
        metrics = update(rollout)
    assert all(value == value for value in metrics.values())
    assert not [name for name, x in loss.named_parameters() if x.requires_grad and torch.equal(x, before[name])]


def test_boolean_entries_are_numbers_to_their_encoder():
    both = modules.dict_encoder({"contact": modules.mlp(2, None, (3,)), "speed": nn.Identity()})
    contact, speed = torch.tensor([[True, False]]), torch.ones(1, 2)
    torch.testing.assert_close(both(contact, speed), both(contact.float(), speed))
