from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.envs import GymEnv, RewardScaling, TransformedEnv
from torchrl.modules import OrnsteinUhlenbeckProcessModule

from pgkit import collectors, data, envs, modules
from pgkit.collectors.policy import RowPolicy, function_of, trace
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
    obs = collector.env.simulator.reset()["observation"]
    act = trace(function_of(actor, ["observation"]), [obs], actor)
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


def test_environments_of_torchrl_are_stepped_with_their_transforms():
    rollouts = []
    for scale in (1.0, 10.0):
        torch.manual_seed(0)
        env = TransformedEnv(envs.make("Pendulum-v1", num_envs=2), RewardScaling(0, scale))
        actor = modules.gaussian_actor(env)
        rollouts.append(collectors.VectorCollector(env, actor, frames_per_batch=20, compile="off").rollout())
    torch.testing.assert_close(rollouts[1]["next", "reward"], 10 * rollouts[0]["next", "reward"])
    assert torch.equal(rollouts[1]["observation"], rollouts[0]["observation"])


def test_an_environment_of_this_process_has_no_workers():
    env = TransformedEnv(envs.make("Pendulum-v1", num_envs=2), RewardScaling(0, 10.0))
    with pytest.raises(UserError, match="TransformedEnv given is in this process, .* give envs.make a function"):
        collectors.AsyncCollector(env, modules.gaussian_actor(env), frames_per_batch=10)


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
    env.make = lambda first, count, seed: 1 / 0
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


def test_the_environment_that_torchrl_s_collector_is_checked_with_is_closed(monkeypatch):
    made = []

    def maker():
        made.append(GymEnv("Pendulum-v1"))
        return made[-1]

    monkeypatch.setattr("torchrl.collectors.Collector", lambda *args, **kwargs: None)
    actor = modules.deterministic_actor(envs.make("Pendulum-v1"))
    collectors.TorchRLCollector([maker, maker], actor, frames_per_batch=10)
    assert [env.is_closed for env in made] == [True]


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


def test_a_policy_of_numpy_and_one_with_a_mode_act_in_evaluation_mode():
    class Scripted(nn.Module):
        def forward(self, obs):
            turned = np.where(obs.numpy() > 25, -1.0, 1.0)
            return torch.as_tensor(turned, dtype=torch.float32) * (1.0 if self.training else 0.5)

    actor = TensorDictModule(Scripted(), in_keys=["observation"], out_keys=["action"])
    collector = collectors.VectorCollector(envs.make(counted(), 2), actor, frames_per_batch=100, compile="off")
    assert collector.rollout()["action"][0].unique().tolist() == [-0.5, 0.5]
    net = nn.Sequential(nn.Linear(1, 1), nn.Dropout(0.5))
    dropout = TensorDictModule(net, ["observation"], ["action"])
    collector = collectors.VectorCollector(envs.make(counted(), 2), dropout, frames_per_batch=100, compile="off")
    for mode in (True, False):
        dropout.train(mode)
        assert not (collector.rollout()["action"] == 0).any() and dropout.training == mode
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


@pytest.mark.parametrize(
    ("kind", "workers"),
    [(collectors.VectorCollector, 1), (collectors.VectorCollector, 2), (collectors.AsyncCollector, 1)],
)
def test_a_state_taken_after_the_shutdown_begins_new_episodes(kind, workers):
    """A run saves after ``break`` and ``shutdown()``."""
    seen = []
    env = envs.make("CartPole-v1", num_envs=2, seed=3, workers=workers)
    state = None
    for _ in range(2):
        collector = kind(env, modules.categorical_actor(env), frames_per_batch=20, compile="off")
        if state is not None:
            collector.load_state_dict(state)
        seen.append(collector.rollout()["observation"][:, 0])
        collector.shutdown()
        state = collector.state_dict()
    assert collector.frames == 40 and not torch.equal(*seen)


def test_an_actor_writes_whole_numbers_too_and_a_random_one_zeros():
    env = envs.make("Pendulum-v1", num_envs=2)
    skill = TensorDictModule(lambda x: (x[:, :1] > -2).long(), in_keys=["observation"], out_keys=["skill"])
    actor = TensorDictSequential(skill, modules.deterministic_actor(env))
    collector = collectors.VectorCollector(env, actor, frames_per_batch=4, init_random_frames=4, compile="off")
    assert [collector.rollout()["skill"].unique().tolist() for _ in range(2)] == [[0], [1]]


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


class Picture(gym.Env):
    """An image that counts steps; ten steps an episode."""

    observation_space, action_space = gym.spaces.Box(0, 255, (1, 12, 12), np.uint8), gym.spaces.Discrete(3)

    def _observe(self):
        return (np.arange(144, dtype=np.int64).reshape(1, 12, 12) * (3 + self.t) % 256).astype(np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = int(self.np_random.integers(5))
        return self._observe(), {}

    def step(self, action):
        self.t += 1 + int(action)
        return self._observe(), float(action), self.t > 10, False, {"picked": int(action)}


class Scale(nn.Module):
    def forward(self, x):
        return x.float() / 255


class Counted(nn.Module):
    """Notices how many rows it is evaluated on."""

    def __init__(self):
        super().__init__()
        self.register_buffer("rows", torch.zeros(()))

    def forward(self, x):
        self.rows.fill_(len(x))
        return x


def conv_agent(workers, num_envs=16, steps=10, compile="off"):
    torch.manual_seed(0)
    env = envs.make(Picture, num_envs=num_envs, seed=2, workers=workers, info=("picked",))
    net = nn.Sequential(Counted(), Scale(), nn.Conv2d(1, 8, 3), nn.ReLU(), nn.Flatten(), nn.Linear(800, 32), nn.ReLU())
    actor = modules.categorical_actor(env, encoder=net)
    frames = num_envs * steps
    return actor, collectors.VectorCollector(env, actor, frames_per_batch=frames, compile=compile)


def test_workers_with_a_convolution_give_the_same_numbers_and_evaluate_their_own_rows_only():
    rollouts = []
    for workers in (1, 2, 4):
        actor, collector = conv_agent(workers)
        rollouts.append(torch.stack([collector.rollout(), collector.rollout()]))
        pool: Any = collector._workers
        held = actor if workers == 1 else pool._actor
        counted = next(part for part in held.modules() if isinstance(part, Counted))
        assert counted.rows == 16 // workers
        collector.shutdown()
    assert all(equal(rollouts[0], other) for other in rollouts[1:])
    first = rollouts[0]
    assert first["observation"].dtype == first["next", "observation"].dtype == torch.uint8
    assert first["next", "picked"].dtype == torch.float32 and torch.equal(
        first["next", "picked"][..., 0], first["action"].float()
    )
    assert first["action"].unique().tolist() == [0, 1, 2]


def test_bytes_stay_bytes_in_the_replay():
    _, collector = conv_agent(1)
    replay = data.ReplayBuffer(collector.env, 200, seed=0)
    rollout = collector.rollout()
    replay.extend(rollout)
    batch = replay.sample(8)
    assert batch["observation"].dtype == batch["next", "observation"].dtype == torch.uint8
    rows = rollout["observation"].flatten(0, 1)
    assert all((rows == x).flatten(1).all(1).any() for x in batch["observation"])


@pytest.mark.parametrize("num_envs", [2, 3, 6])
def test_few_and_uneven_environments_give_the_same_numbers_too(num_envs):
    rollouts = []
    for workers in (1, 2, num_envs):
        _, collector = make("HalfCheetah-v5", workers=workers, num_envs=num_envs, steps=10)
        rollouts.append(collector.rollout())
        collector.shutdown()
    assert all(equal(rollouts[0], other) for other in rollouts[1:])


def test_random_actions_do_not_depend_on_the_workers():
    rollouts = []
    for workers in (1, 3):
        _, collector = make("HalfCheetah-v5", workers=workers, num_envs=6, init_random_frames=1)
        rollouts.append(collector.rollout())
        collector.shutdown()
    actions = rollouts[0]["action"]
    assert torch.equal(actions, rollouts[1]["action"]) and actions.abs().max() <= 1
    assert actions.mean().abs() < 0.05 and abs(actions.var() - 1 / 3) < 0.02  # 1,800 draws, uniform
    assert rollouts[0]["action_log_prob"].isnan().all()


class Skewed(TensorDictModuleBase):
    """Draws from a gamma distribution, by rejection."""

    def __init__(self):
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], ["action"]

    def forward(self, tensordict):
        shape = tensordict["observation"].abs() + 1
        return tensordict.set("action", torch.distributions.Gamma(shape[..., :1], 1.0).sample())


def test_a_policy_that_draws_by_rejection_repeats_itself_and_says_what_it_depends_on(caplog):
    rollouts = []
    with caplog.at_level("INFO", "pgkit"):
        for _ in range(2):
            env = envs.make("Pendulum-v1", num_envs=4, seed=1)
            collector = collectors.VectorCollector(env, Skewed(), frames_per_batch=40, compile="off")
            rollouts.append(torch.stack([collector.rollout(), collector.rollout()]))
    assert equal(*rollouts) and "depend on the number of workers" in caplog.text
    assert not torch.equal(rollouts[0]["action"][0], rollouts[0]["action"][1])


@pytest.mark.parametrize("entry", ["observation", "reward"])
def test_numbers_that_are_not_finite_are_named_before_the_rollout_is_handed_out(entry):
    class Breaks(counted()):
        def step(self, action):
            obs, reward, *rest = super().step(action)
            if self.t == 7:
                obs, reward = (obs * np.nan, reward) if entry == "observation" else (obs, np.inf)
            return obs, reward, *rest

    env = envs.make(Breaks, num_envs=2)
    collector = collectors.VectorCollector(env, modules.gaussian_actor(env), frames_per_batch=8, compile="off")
    collector.rollout()
    value = "nan" if entry == "observation" else "inf"
    with pytest.raises(UserError, match=rf"'next.{entry}' of environment 0 is {value} at step 2 of the rollout"):
        collector.rollout()


def test_rows_whose_action_is_ignored_are_masked_and_no_frames():
    env = envs.make(gym.make_vec("CartPole-v1", num_envs=4), seed=1)
    actor = modules.categorical_actor(env)
    collector = collectors.VectorCollector(env, actor, frames_per_batch=400, total_frames=600, compile="off")
    rollout = next(iter(collector))
    mask, done = rollout["collector", "mask"], rollout["next", "done"][..., 0]
    assert mask.shape == (4, 100) and 380 <= mask.sum() < 400 and collector.frames == mask.sum()
    assert torch.equal(~mask[:, 1:], done[:, :-1]) and mask[:, 0].all()
    assert (rollout["next", "reward"][..., 0][~mask] == 0).all()
    assert sum(1 for _ in collector) == 1
    lengths = rollout["next", "step_count"][..., 0]
    assert (lengths[~mask] == 0).all() and (lengths[mask] >= 1).all()


def test_a_memory_begins_where_an_episode_does_after_a_masked_row():
    env = envs.make(gym.make_vec("CartPole-v1", num_envs=2), seed=1)
    actor = modules.categorical_actor(env, encoder=modules.gru(env, 4, (4,)))
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=200, compile="off").rollout()
    begins = rollout["is_init"][..., 0]
    assert begins[:, 0].all() and torch.equal(begins[:, 1:], ~rollout["collector", "mask"][:, :-1])


def test_the_policy_s_noise_is_its_own_for_every_environment_and_step():
    draws = []
    for rows, first in ((8, 0), (3, 2)):
        policy = RowPolicy(lambda x: (torch.randn_like(x),), [torch.zeros(rows, 5)], 8, first, 3, torch.nn.Identity())
        for step in (0, 30):
            with policy.steps(step, 40) as noise:
                draws.append(torch.stack([policy([torch.zeros(rows, 5)], noise[t])[0].clone() for t in range(40)]))
    assert torch.equal(draws[0][30:], draws[1][:10]) and torch.equal(draws[0][:, 2:5], draws[2][:, :3])
    assert len(draws[0].unique()) == draws[0].numel() and abs(draws[0].std() - 1) < 0.1
