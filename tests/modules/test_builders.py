import gymnasium as gym
import pytest
import torch
from torch import nn
from torchrl.envs import GymEnv
from torchrl.modules import ProbabilisticActor

from pgkit import envs, losses, modules
from pgkit.errors import UserError


def test_orthogonal_gains():
    torch.manual_seed(0)
    net = modules.mlp(10, 3, (32,), out_gain=0.01)
    first, last = (net.get_parameter(f"{i}.weight") for i in (0, 2))
    torch.testing.assert_close(first.T @ first, 2 * torch.eye(10), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(last @ last.T, 1e-4 * torch.eye(3), atol=1e-7, rtol=1e-3)
    assert first.count_nonzero() > 0 and net.get_parameter("0.bias").count_nonzero() == 0


@pytest.mark.parametrize("make", [lambda: envs.make("Pendulum-v1", num_envs=4), lambda: GymEnv("Pendulum-v1")])
def test_builders_take_any_torchrl_env(make):
    env = make()
    out = modules.gaussian_actor(env, log_std=-0.5)(env.reset())
    assert out["action"].shape == (*env.batch_size, 1)
    assert out["action_log_prob"].shape == env.batch_size
    torch.testing.assert_close(out["scale"], torch.full_like(out["scale"], 0.6065306))
    assert modules.state_value(env)(env.reset())["state_value"].shape == (*env.batch_size, 1)
    squashed = modules.tanh_normal_actor(env)(env.reset())["action"]
    assert squashed.abs().max() <= 2.0


def test_discrete_as_index_and_as_one_hot():
    env = envs.make("CartPole-v1", num_envs=4)
    assert modules.categorical_actor(env)(env.reset())["action"].shape == (4,)
    theirs = GymEnv("CartPole-v1")
    assert modules.categorical_actor(theirs)(theirs.reset())["action"].shape == (2,)


def test_wrong_builder_names_the_right_one():
    with pytest.raises(UserError, match="use modules.categorical_actor"):
        modules.gaussian_actor(envs.make("CartPole-v1"))
    with pytest.raises(UserError, match=r"use modules.gaussian_actor"):
        modules.categorical_actor(envs.make("Pendulum-v1"))


def test_who_trains_a_shared_encoder():
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=4)
    encoder = modules.mlp(3, None, (16,))
    actor = modules.gaussian_actor(env, encoder=encoder)
    critic = modules.state_value(env, encoder=encoder)
    batch = actor(env.reset()).detach()
    batch["advantage"], batch["value_target"] = torch.randn(4, 1), torch.randn(4, 1)

    def encoder_gradients(separate):
        loss = losses.ClipPPOLoss(actor, critic, separate_losses=separate)
        out = loss(batch)
        weight = encoder[0].weight
        return [torch.autograd.grad(out[key], weight, allow_unused=True, retain_graph=True)[0] is not None
                for key in ("loss_objective", "loss_critic")]  # fmt: skip

    assert encoder_gradients(separate=False) == [True, True]
    assert encoder_gradients(separate=True) == [True, False]


def test_encoder_for_other_shapes():
    env = envs.make("Pendulum-v1", num_envs=2)
    encoder = nn.Sequential(nn.Linear(3, 5), nn.ReLU())
    assert modules.state_value(env, encoder=encoder)(env.reset())["state_value"].shape == (2, 1)


def test_a_saturated_squashed_action_can_be_scored_again_if_the_mean_is_bounded():
    # PPO scores stored actions: without tanh_loc the recovered pre-image of a saturated action is far off
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", num_envs=64)
    actor = modules.tanh_normal_actor(env, tanh_loc=True, log_std_bounds=(-3, -1))
    bias = actor.get_parameter("module.0.module.1.linear.bias")
    for loc, tolerance in ((1e3, 0.1), (-1e3, 0.1), (0.5, 1e-3)):
        with torch.no_grad():
            bias[0] = loc
        out = actor(env.reset())
        again = actor.get_dist(out.select("observation")).log_prob(out["action"])
        torch.testing.assert_close(again, out["action_log_prob"], rtol=0, atol=tolerance)
    unbounded = modules.tanh_normal_actor(env)
    with torch.no_grad():
        unbounded.get_parameter("module.0.module.1.linear.bias")[0] = 30.0
    out = unbounded(env.reset())
    again = unbounded.get_dist(out.select("observation")).log_prob(out["action"])
    assert (again - out["action_log_prob"]).abs().min() > 10  # the trap itself


@pytest.mark.parametrize("tanh_loc", [False, True])
def test_a_squashed_action_reaches_both_ends_of_its_range(tanh_loc):
    class Positive(gym.Env):
        observation_space, action_space = gym.spaces.Box(-1, 1, (3,)), gym.spaces.Box(0, 10, (1,))

    env = envs.make(Positive)
    actor = modules.tanh_normal_actor(env, tanh_loc=tanh_loc)
    bias, ends = actor.get_parameter("module.0.module.1.linear.bias"), []
    for loc in (-1e3, 0.0, 1e3):
        with torch.no_grad():
            bias[0] = loc
            ends.append(actor.get_dist(env.observation_spec.zero()).deterministic_sample.item())
    assert ends == pytest.approx([0.0, 5.0, 10.0], abs=0.3)


@pytest.mark.parametrize("builder", [modules.state_value, modules.q_value, modules.gaussian_actor])
def test_building_with_an_encoder_leaves_its_statistics_alone(builder):
    env = envs.make("Pendulum-v1")
    encoder = nn.Sequential(nn.Linear(3, 5), nn.BatchNorm1d(5), nn.Dropout().eval())
    builder(env, encoder=encoder)
    assert encoder[1].num_batches_tracked == 0
    assert [module.training for module in encoder] == [True, True, False]


@pytest.mark.parametrize("make", [modules.gaussian_actor, modules.tanh_normal_actor, modules.deterministic_actor])
def test_actions_that_are_no_vector_are_refused(make):
    class Matrix(gym.Env):
        observation_space, action_space = gym.spaces.Box(-1, 1, (3,)), gym.spaces.Box(-1, 1, (2, 3))

    with pytest.raises(UserError, match=r"actions have shape \(2, 3\)"):
        make(envs.make(Matrix))


@pytest.mark.parametrize("build", [modules.tanh_normal_actor, modules.deterministic_actor, modules.gaussian_actor])
@pytest.mark.parametrize("how", ["default", "given", "moved"])
def test_the_bounds_of_an_action_lie_where_the_weights_are(build, how):
    """A GPU, which the meta device stands for here, would get a copy of them in every call, or refuse them."""
    env = envs.make("Pendulum-v1")
    with torch.device("meta" if how == "default" else "cpu"):
        actor = build(env, (8,), device="meta" if how == "given" else None)
    actor = actor.to("meta") if how == "moved" else actor
    settings = getattr(actor[-1], "distribution_kwargs", {}) if isinstance(actor, ProbabilisticActor) else {}
    tensors = [*actor.parameters(), *actor.buffers(), *(x for x in settings.values() if isinstance(x, torch.Tensor))]
    assert {x.device.type for x in tensors} == {"meta"}
