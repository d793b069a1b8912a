"""Rendered and stacked observations, and Atari: shapes, types, values, and what is said where they cannot be."""

import importlib
import logging
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch

from pgkit import data, envs, losses, modules
from pgkit.envs import ids, rendering
from pgkit.envs.pixels import FrameStack, Pixels
from pgkit.errors import UserError
from tests.recipes.stand_ins import Bar

CARTPOLE = "dm_control/cartpole-swingup-v0"


def bar(**kwargs):
    return lambda: Bar(render_mode="rgb_array", **kwargs)


def test_pictures_are_channels_first_bytes_and_a_copy():
    env = Pixels(Bar(size=20, render_mode="rgb_array"), 20)
    first, _ = env.reset(seed=3)
    assert first.shape == (3, 20, 20) and first.dtype == np.uint8 and first.flags.c_contiguous
    expected = env.unwrapped._draw()[0, :, ::-1]
    for channel in first:
        np.testing.assert_array_equal(channel, expected)
    kept = first.copy()
    env.step(np.ones(1))
    np.testing.assert_array_equal(first, kept)


def test_another_size_is_the_mean_of_what_it_covers():
    picture = np.zeros((40, 40, 3), np.uint8)
    picture[:20] = 100
    small = rendering.resized(picture, 4)
    assert small.shape == (4, 4, 3) and small[0].tolist() == [[100] * 3] * 4 and small[3].tolist() == [[0] * 3] * 4
    assert envs.make(bar(size=40), pixels=8).reset()["observation"].shape == (1, 3, 8, 8)


def test_stacks_repeat_the_first_frame_and_have_the_newest_last():
    env = FrameStack(Bar(size=20), 3)
    obs, _ = env.reset(seed=0)
    single = [obs[2]] * 3
    assert env.observation_space.shape == obs.shape == (3, 20, 20)
    for _ in range(4):
        np.testing.assert_array_equal(obs, np.stack(single[-3:]))
        obs, *_ = env.step(np.ones(1))
        single.append(env.unwrapped._draw()[0].copy())
    np.testing.assert_array_equal(env.reset(seed=1)[0], np.stack([env.unwrapped._draw()[0]] * 3))


def test_bytes_from_the_simulator_to_the_replay_which_keeps_each_frame_once():
    env = envs.make(lambda: Bar(size=20), num_envs=2, frame_stack=3, seed=1)
    assert vars(env)["frame_stack"] == 3
    buffer = data.ReplayBuffer(env, 200)
    rollout = env.rollout(30, break_when_any_done=False)  # twelve steps are an episode
    buffer.extend(rollout)
    assert buffer.table.stacked == {"observation": 3} and rollout["observation"].dtype == torch.uint8
    batch = buffer.gather(1.0)(buffer.data, torch.arange(60))
    for ours, theirs in ((batch, rollout), (batch["next"], rollout["next"])):
        assert ours["observation"].dtype == torch.uint8
        torch.testing.assert_close(ours["observation"], theirs["observation"].transpose(0, 1).flatten(0, 1))


def test_mujoco_is_drawn_as_dm_control_draws_it_and_the_choice_is_said_once(caplog):
    rendering.say_who_draws.cache_clear()
    with caplog.at_level(logging.INFO, "pgkit"):
        env = envs.make(CARTPOLE, pixels=84, frame_stack=3, action_repeat=4)
        rollout = env.rollout(2)
        envs.make(CARTPOLE, pixels=84).reset()
    assert sum("rendering with MUJOCO_GL=" in line for line in caplog.messages) == 1
    assert rollout["observation"].shape == (1, 2, 9, 84, 84) and rollout["observation"].dtype == torch.uint8
    physics = env.simulator.envs[0].unwrapped._env.physics
    newest = rollout["next", "observation"][0, -1, 6:].permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(newest, physics.render(84, 84, camera_id=0))
    again = envs.make(CARTPOLE, pixels=84, frame_stack=3, action_repeat=4).reset()["observation"]
    torch.testing.assert_close(again[0], rollout["observation"][0, 0])


def test_a_new_model_is_drawn_by_a_new_renderer_and_the_old_one_is_given_back(monkeypatch):
    """dm_control's composer makes a model for every episode."""
    made = []

    class Kept(rendering.MuJoCo):
        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)

    monkeypatch.setattr(rendering, "MuJoCo", Kept)
    env = envs.make(CARTPOLE, pixels=16).simulator.envs[0]
    cartpole = importlib.import_module("dm_control.suite.cartpole")  # MUJOCO_GL is chosen by now
    env.reset(seed=0)
    env.unwrapped._env.physics.reload_from_xml_string(*cartpole.get_model_and_assets())
    assert env.picture().shape == (3, 16, 16)
    assert [renderer.context._context is None for renderer in made] == [True, False]


def test_a_fast_picture_is_another_one_and_the_physics_are_the_same():
    plain, fast = (envs.make(CARTPOLE, pixels=84, fast_render=fast) for fast in (False, True))
    shown = [env.reset()["observation"] for env in (plain, fast)]
    differs = (shown[0] != shown[1]).any(1).float().mean()
    assert 0.01 < differs < 0.6
    states = [env.simulator.envs[0].unwrapped._env.physics.get_state() for env in (plain, fast)]
    np.testing.assert_array_equal(*states)


def test_gymnasiums_mujoco_at_the_size_that_is_asked_for():
    env = envs.make("InvertedPendulum-v5", pixels=32, frame_stack=2)
    shown = env.rollout(2)["observation"]
    assert shown.shape == (1, 2, 6, 32, 32) and shown.float().std() > 5
    assert env.simulator.envs[0].unwrapped.model.vis.quality.shadowsize <= rendering.SHADOW_MAP


def test_a_missing_library_names_the_packages(monkeypatch):
    env = envs.make(CARTPOLE, pixels=84)
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    with pytest.raises(UserError) as drawn:
        env.reset()
    imported = ids._not_installed(CARTPOLE, ImportError("no OSMesa\nhere"))
    for text in map(str, (drawn.value, imported)):
        assert "libegl1 libgl1-mesa-dri" in text and "libosmesa6" in text and "\n" not in text


def test_the_backend_is_egl_else_osmesa_else_none_and_a_choice_of_ones_own_stays(monkeypatch):
    for egl, osmesa, expected in ((True, True, "egl"), (False, True, "osmesa"), (False, False, None)):
        monkeypatch.delenv("MUJOCO_GL", raising=False)
        monkeypatch.setattr(rendering, "_egl", lambda works=egl: works)
        monkeypatch.setattr(rendering, "_osmesa", lambda works=osmesa: works)
        assert rendering.choose_backend() == expected
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert rendering.choose_backend() == "glfw"


def test_clipped_rewards_are_for_training_and_scores_are_not_clipped():
    env = envs.make(lambda: Bar(scale=100.0), reward_clipping=True)
    env.reset()
    step = env.simulator.step({"action": torch.ones(1, 1)})
    assert step.reward["reward"].item() == 1.0 and env.simulator.episode_reward["reward"].item() > 5.0


def test_atari_is_gray_stacked_bytes_and_is_replayed_exactly():
    env = envs.make("ALE/Pong-v5", num_envs=2, seed=5)
    rollout = env.rollout(40, break_when_any_done=False)
    assert rollout["observation"].shape == (2, 40, 4, 84, 84) and rollout["observation"].dtype == torch.uint8
    assert vars(env)["frame_stack"] == 4 and env.simulator.resume == "exact"
    game = env.simulator.envs[0].unwrapped
    assert game.spec.kwargs["repeat_action_probability"] == 0.25 and game.spec.kwargs["frameskip"] == 1
    other = envs.make("ALE/Pong-v5", num_envs=2, seed=9)
    resumed = other.simulator.load_state_dict(env.simulator.state_dict())["observation"]
    torch.testing.assert_close(resumed, rollout["next", "observation"][:, -1])
    action = {"action": torch.full((2,), 3)}
    steps = [x.simulator.step(action).next["observation"].clone() for x in (env, other)]
    torch.testing.assert_close(*steps)


def test_ataris_options_are_keywords():
    env = envs.make(
        "ALE/Pong-v5", frame_stack=2, pixels=42, grayscale=False, frameskip=2, noop=0, reward_clipping=False,
        repeat_action_probability=0.0,
    )  # fmt: skip
    assert env.reset()["observation"].shape == (1, 6, 42, 42)
    one = env.simulator.envs[0]
    assert not env.simulator.clip_rewards and one.unwrapped.spec.kwargs["repeat_action_probability"] == 0.0
    with pytest.raises(UserError, match="an episode is a whole game"):
        envs.make("ALE/Pong-v5", episodic_life=True)
    with pytest.raises(UserError, match="'ALE/Pang-v5'.*ALE/Pong-v5"):
        envs.make("ALE/Pang-v5")


@pytest.mark.parametrize("package", ["ale_py", "cv2"])
def test_a_package_of_atari_that_is_missing_is_named(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError, match=f"needs the package '{package}'.*extra 'atari'"):
        envs.make("ALE/Pong-v5")


def test_a_game_whose_rom_is_missing_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv("ALE_ROMS_DIR", str(tmp_path))
    with pytest.raises(UserError, match="its ROM cannot be read.*install ale-py anew"):
        envs.make("ALE/Pong-v5")


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: envs.make(lambda: Bar(), pixels=84).reset(), "render_mode=None: make it with render_mode='rgb_array'"),
        (lambda: envs.make(bar(), pixels=20, fast_render=True).reset(), "fast_render=True is for MuJoCo"),
        (lambda: envs.make(bar(), fast_render=True), "give pixels=84"),
        (lambda: envs.make(bar(), pixels=0), "pixels=0"),
        (lambda: envs.make(lambda: Last(), frame_stack=2), "channels last: put them first"),
        (lambda: modules.conv_encoder(envs.make(lambda: Last())), "channels come last"),
        (lambda: envs.make("Blackjack-v1", frame_stack=2), "frame_stack=2 stacks one array"),
        (lambda: envs.make(gym.make_vec("CartPole-v1", 2), frame_stack=2), "frame_stack= is for single"),
        (lambda: data.ReplayBuffer(envs.make(bar(), frame_stack=5), 4), "is longer than the 4 steps"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_said_in_one_line(make, match):
    with pytest.raises(UserError, match=match) as error:
        make()
    assert "\n" not in str(error.value)


class Last(gym.Env):
    """Channels last, as most cameras give them."""

    observation_space = gym.spaces.Box(0, 255, (20, 20, 3), np.uint8)
    action_space = gym.spaces.Discrete(2)
    render_mode = None


def test_float_images_beyond_one_are_refused():
    encoder = modules.conv_encoder(envs.make(lambda: Bar(size=20)))
    with pytest.raises(UserError, match="float images must lie within"):
        encoder(torch.full((2, 1, 20, 20), 2.0))


def test_copies_have_shifts_of_their_own_and_the_loss_averages_over_them():
    # one row, two copies, no shift: the same numbers as the plain loss of that row, whatever the number of copies
    env = envs.make(lambda: Bar(size=20), frame_stack=2)
    torch.manual_seed(0)
    encoder = modules.conv_encoder(env)
    own = modules.conv_encoder(env, shared=encoder, detach=True)
    critic = modules.q_value(env, 1, (4,), encoder=encoder)
    settings = {"delay_actor": False, "delay_value": False, "augmented": True}
    loss = losses.DDPGLoss(modules.deterministic_actor(env, encoder=own), critic, **settings)
    row = env.rollout(1).squeeze(0)
    same = loss(modules.random_shift(0, copies=3)(row))
    once = loss(modules.random_shift(0, copies=1)(row))
    torch.testing.assert_close(same["loss_value"], once["loss_value"])
    shifted = modules.random_shift(4, copies=8)(row)
    assert shifted.shape == (8, 1) and shifted["next", "reward"].shape == (8, 1, 1)
    assert len(shifted["observation"].flatten(1).unique(dim=0)) > 1 and row["observation"].shape == (1, 2, 20, 20)
    with pytest.raises(UserError, match="copies"):
        modules.random_shift(4, copies=0)
