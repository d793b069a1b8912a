import pytest
import torch
from torch import nn
from torchrl.envs import GymEnv

from pgkit import collectors, envs, modules
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
