import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.envs import GymEnv, RewardScaling, TransformedEnv
from torchrl.modules import OrnsteinUhlenbeckProcessModule

from pgkit import collectors, envs, modules
from pgkit.collectors.policy import trace
from pgkit.errors import UserError


def make(env_id="Pendulum-v1", workers=1, num_envs=4, steps=50, compile="off", **kwargs):
    torch.manual_seed(0)
    env = envs.make(env_id, num_envs=num_envs, seed=3, workers=workers)
    build = modules.gaussian_actor if env.action_spec.dtype.is_floating_point else modules.categorical_actor
    actor = build(env, normalizer=modules.ObsNormalizer(env))
    return actor, collectors.VectorCollector(env, actor, frames_per_batch=num_envs * steps, compile=compile, **kwargs)


def head_of(actor):
    return actor.get_submodule("module.0.module")[-1]


def equal(a, b):
    return set(a.keys(True, True)) == set(b.keys(True, True)) and bool((a == b).all())


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
def test_rollout_has_torchrls_keys_and_shapes(env_id):
    _, collector = make(env_id)
    rollout = collector.rollout()
    assert rollout.batch_size == (4, 50)
    keys = {"observation", "action", "action_log_prob"}
    nexts = ("observation", "reward", "terminated", "truncated", "done", "episode_reward", "step_count")
    assert set(rollout.keys(True, True)) == keys | {("next", key) for key in nexts}
    for key in nexts[1:]:
        assert rollout["next", key].shape == (4, 50, 1)
    assert rollout["action_log_prob"].shape == (4, 50)
    going_on = ~rollout["next", "done"][:, :-1, 0]
    assert torch.equal(rollout["next", "observation"][:, :-1][going_on], rollout["observation"][:, 1:][going_on])


def test_reset_observation_is_never_the_next_observation():
    _, collector = make("CartPole-v1", steps=200)
    rollout = collector.rollout()
    done = rollout["next", "done"][..., 0]
    assert done.sum() > 10
    assert (rollout["next", "observation"][done].abs().amax(-1) > 0.2).all()  # poles that fell
    assert (rollout["observation"][:, 1:][done[:, :-1]].abs() <= 0.05).all()  # CartPole's starts


def test_log_probability_is_that_of_the_stored_action():
    actor, collector = make("HalfCheetah-v5", steps=20)
    rollout = collector.rollout()
    again = actor.get_dist(rollout.select("observation")).log_prob(rollout["action"])
    torch.testing.assert_close(rollout["action_log_prob"], again, rtol=1e-4, atol=1e-5)
    assert rollout["action"].abs().max() > 1  # as sampled, not as clipped


def test_the_number_of_workers_does_not_change_the_numbers():
    rollouts = []
    for workers in (1, 2, 4):
        actor, collector = make("HalfCheetah-v5", workers=workers, steps=20)
        first = collector.rollout()
        with torch.no_grad():
            for p in actor.parameters():
                p.mul_(1.1)
        rollouts.append((first, collector.rollout()))
        collector.shutdown()
    for other in rollouts[1:]:
        assert equal(rollouts[0][0], other[0]) and equal(rollouts[0][1], other[1])


def test_new_weights_take_effect_and_the_global_generator_does_not():
    actor, collector = make()
    torch.manual_seed(123)
    a, state = collector.rollout(), torch.get_rng_state()
    torch.manual_seed(123)
    assert torch.equal(state, torch.get_rng_state())
    _, again = make()
    assert equal(a, again.rollout())
    with torch.no_grad():
        head_of(actor).log_std.fill_(-20.0)
    quiet = collector.rollout()
    mean = actor.get_dist(quiet.select("observation")).base_dist.loc
    torch.testing.assert_close(quiet["action"], mean)
    head_of(actor).log_std = torch.nn.Parameter(torch.zeros(1))  # replaced, not changed in place
    assert (collector.rollout()["action"] - mean).abs().max() > 0.5


def test_compiled_policy_sees_new_weights_and_agrees_for_any_number_of_workers():
    rollouts = []
    for workers, compile in ((1, "on"), (2, "on"), (1, "off")):
        actor, collector = make("HalfCheetah-v5", workers=workers, steps=5, compile=compile)
        collector.rollout()
        with torch.no_grad():
            for p in actor.parameters():
                p.add_(0.3)
            for key, buffer in actor.named_buffers():
                buffer.fill_(2.0 if "var" in key else 0.1)
        rollouts.append(collector.rollout())
        collector.shutdown()
    assert equal(rollouts[0], rollouts[1])
    torch.testing.assert_close(rollouts[0][:, 0]["action"], rollouts[2][:, 0]["action"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(rollouts[0]["action_log_prob"], rollouts[2]["action_log_prob"], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("before", "after"), [(1, 1), (2, 1), (1, 2)])
def test_resume_is_exact_for_any_number_of_workers(before, after):
    _, collector = make("CartPole-v1", workers=before)
    collector.rollout()
    state = collector.state_dict()
    expected = collector.rollout()
    collector.shutdown()
    _, other = make("CartPole-v1", workers=after)
    other.load_state_dict(state)
    assert equal(other.rollout(), expected) and other.frames == collector.frames == 400
    other.shutdown()


def test_traced_policy_is_the_actor_bit_for_bit():
    actor, collector = make()
    obs = torch.from_numpy(collector.env.arrays.reset())
    act = trace(actor, obs)
    torch.manual_seed(5)
    traced = act(obs)
    torch.manual_seed(5)
    td = actor(collector.env.reset().set("observation", obs))
    assert torch.equal(traced[0], td["action"]) and torch.equal(traced[1], td["action_log_prob"])


def test_episode_totals():
    _, collector = make("CartPole-v1", steps=100)
    rollout = collector.rollout()
    done = rollout["next", "done"]
    ends = done[0, :, 0].nonzero().flatten()
    lengths = torch.diff(ends, prepend=torch.tensor([-1]))
    assert torch.equal(rollout["next", "step_count"][0][done[0]], lengths)
    assert torch.equal(rollout["next", "episode_reward"][0][done[0]], lengths.float())  # a reward of 1 a step


def test_frames_are_counted_and_bounded():
    _, collector = make(total_frames=500)
    assert [collector.frames for _ in collector] == [200, 400, 600]
    with pytest.raises(UserError, match="total_frames=100 is less than one rollout"):
        make(total_frames=100)
    with pytest.raises(UserError, match="not a multiple of the 4 environments"):
        env = envs.make("Pendulum-v1", num_envs=4)
        collectors.VectorCollector(env, modules.gaussian_actor(env), frames_per_batch=50)


@pytest.mark.parametrize("collector", [collectors.VectorCollector, collectors.AsyncCollector])
def test_environments_of_torchrl_are_refused(collector):
    env = envs.make("Pendulum-v1", num_envs=2)
    scaled = TransformedEnv(env, RewardScaling(0, 1000))  # silently unscaled otherwise
    with pytest.raises(UserError, match="a TransformedEnv is none of that: use collectors.TorchRLCollector"):
        collector(scaled, modules.gaussian_actor(env), frames_per_batch=10)


def test_an_actor_of_another_env():
    actor, _ = make("CartPole-v1")
    misfit = r"cannot read observations of shape \(3,\).*built for another environment.*must match the size"
    with pytest.raises(UserError, match=misfit):
        collectors.VectorCollector(envs.make("Pendulum-v1"), actor, frames_per_batch=10)
    reacher = modules.gaussian_actor(envs.make("Hopper-v5"))  # 11 observations, as InvertedDoublePendulum v4 had
    with pytest.raises(UserError, match="built for another environment"):
        collectors.VectorCollector(envs.make("HalfCheetah-v5"), reacher, frames_per_batch=10)


def test_a_failing_worker_reports_its_traceback():
    env = envs.make("Pendulum-v1", num_envs=2, workers=2)
    collector = collectors.VectorCollector(env, modules.gaussian_actor(env), frames_per_batch=4)
    env.make_env = lambda: 1 / 0
    with pytest.raises(RuntimeError, match="collector worker 0 failed:(.|\n)*ZeroDivisionError"):
        collector.rollout()


def test_torchrl_collector_gives_the_same_seam():
    env = envs.make("CartPole-v1", num_envs=2, seed=1)
    actor = modules.categorical_actor(env)
    collector = collectors.TorchRLCollector(env, actor, frames_per_batch=100, total_frames=200)
    rollouts = list(collector)
    assert collector.frames == 200 and rollouts[0].batch_size == (2, 50)
    _, own = make("CartPole-v1")
    assert set(own.rollout().keys(True, True)) <= set(rollouts[0].keys(True, True))
    done = rollouts[0]["next", "done"]
    lengths = rollouts[0]["next", "step_count"][done]
    assert torch.equal(rollouts[0]["next", "episode_reward"][done], lengths.float())


def test_torchrl_environments_that_do_not_fit_are_named():
    env = GymEnv("InvertedPendulum-v5")  # its observations are float64
    actor = modules.gaussian_actor(env)
    with pytest.raises(UserError, match="'observation' is float64, the actor's weights are float32: convert it"):
        collectors.TorchRLCollector(env, actor, frames_per_batch=8)
    env = GymEnv("Pendulum-v1")
    actor = modules.gaussian_actor(env, encoder=modules.gru(env, 4))
    with pytest.raises(UserError, match="SerialEnv"):
        collectors.TorchRLCollector(env, actor, frames_per_batch=8)


def test_torchrl_collector_ends_at_total_frames_after_a_resume():
    env = envs.make("CartPole-v1", num_envs=2, seed=1)
    collector = collectors.TorchRLCollector(env, modules.categorical_actor(env), frames_per_batch=20, total_frames=100)
    collector.load_state_dict({"frames": 60})
    assert [collector.frames for _ in collector] == [80, 100]


def counted():
    """Observations count the steps of an episode."""

    class Counting(gym.Env):
        observation_space, action_space = gym.spaces.Box(0, 1e6, (1,)), gym.spaces.Box(-1, 1, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.t = 0
            return np.zeros(1, "f4"), {}

        def step(self, action):
            self.t += 1
            return np.full(1, self.t, "f4"), float(action[0]), False, False, {}

    return Counting


def test_a_policy_of_numpy_and_one_that_changes_its_mode_act_as_they_are():
    class Scripted(nn.Module):
        def forward(self, obs):
            turned = np.where(obs.numpy() > 25, -1.0, 1.0)
            return torch.as_tensor(turned, dtype=torch.float32) * (1.0 if self.training else 0.5)

    actor = TensorDictModule(Scripted(), in_keys=["observation"], out_keys=["action"])
    collector = collectors.VectorCollector(envs.make(counted(), 2), actor, frames_per_batch=100, compile="off")
    assert collector.rollout()["action"][0].unique().tolist() == [-1.0, 1.0]
    net = nn.Sequential(nn.Linear(1, 1), nn.Dropout(0.5))
    dropout = TensorDictModule(net, ["observation"], ["action"])
    collector = collectors.VectorCollector(envs.make(counted(), 2), dropout, frames_per_batch=100, compile="off")
    assert (collector.rollout()["action"] == 0).any()
    dropout.eval()
    assert (collector.rollout()["action"] != 0).any() and not (collector.rollout()["action"] == 0).any()
    net[0] = nn.Linear(1, 1)
    nn.init.zeros_(net[0].weight)
    nn.init.constant_(net[0].bias, 7.0)
    assert (collector.rollout()["action"] == 7).all()


def test_after_an_interrupted_rollout_the_next_is_whole(monkeypatch):
    env = envs.make(counted(), 2, workers=2)
    actor = modules.gaussian_actor(env)
    collector = collectors.VectorCollector(env, actor, frames_per_batch=100, compile="off")
    collector.rollout()

    def interrupted():
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(collector._workers, "finish", interrupted)
        collector.rollout()
    for _ in range(2):
        steps = collector.rollout()["observation"][..., 0]
        assert (steps.diff(dim=1) == 1).all()
    collector.shutdown()


def test_a_choice_whose_mask_allows_nothing_is_refused():
    class Masked(gym.Env):
        action_space = gym.spaces.MultiDiscrete([2, 3])
        observation_space = gym.spaces.Dict(x=gym.spaces.Box(-1, 1, (1,)), action_mask=gym.spaces.MultiBinary(5))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return {"x": np.zeros(1, "f4"), "action_mask": np.array([0, 0, 1, 1, 1], "i1")}, {}

        def step(self, action):
            return self.reset()[0], 0.0, False, False, {}

    env = envs.make(Masked, flatten=False)
    actor = modules.categorical_actor(env, encoder=modules.dict_encoder({"x": nn.Linear(1, 4)}))
    with pytest.raises(UserError, match="action_mask allows no action"):
        collectors.VectorCollector(env, actor, frames_per_batch=4, compile="off").rollout()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_state_taken_before_the_first_rollout_is_restored(workers):
    _, collector = make(workers=workers)
    state = collector.state_dict()
    expected = collector.rollout()
    collector.shutdown()
    _, other = make(workers=workers)
    other.load_state_dict(state)
    assert equal(other.rollout(), expected)
    other.shutdown()


def test_noise_that_is_kept_in_the_tensordict_is_refused():
    env = envs.make("Pendulum-v1", num_envs=2)
    noise = OrnsteinUhlenbeckProcessModule(spec=env.action_spec, annealing_num_steps=100)
    policy = TensorDictSequential(modules.deterministic_actor(env), noise)
    with pytest.raises(UserError, match="modules.OrnsteinUhlenbeck"):
        collectors.VectorCollector(env, policy, frames_per_batch=64)


class Annealed(TensorDictModuleBase):
    """An actor with noise whose size is a plain number."""

    def __init__(self, actor):
        super().__init__()
        self.actor, self.std = actor, 0.5
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys

    def forward(self, tensordict):
        out = self.actor(tensordict)
        out["action"] = out["action"] + self.std * torch.randn_like(out["action"])
        return out


@pytest.mark.parametrize("workers", [1, 2])
def test_a_number_of_the_actor_that_changes_takes_effect(workers, caplog):
    env = envs.make("Pendulum-v1", num_envs=2, seed=1, workers=workers)
    actor = modules.deterministic_actor(env, (8,))
    noisy = Annealed(actor)
    collector = collectors.VectorCollector(env, noisy, frames_per_batch=40, compile="off")
    first = collector.rollout()
    noisy.std = 0.0
    second = collector.rollout()
    collector.shutdown()
    for rollout, exact in ((first, False), (second, True)):
        action = rollout["action"].clone()
        assert torch.allclose(action, actor(rollout.clone())["action"], atol=1e-6) == exact
    assert torch.equal(second["observation"][:, 0], first["next", "observation"][:, -1])  # the episodes go on
    assert ("workers start again" in caplog.text) == (workers > 1)
