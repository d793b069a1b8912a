"""The replay buffer against the rollouts it was filled from, frame by frame."""

from functools import partial

import gymnasium as gym
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, SerialEnv

from pgkit import collectors, data, envs, modules
from pgkit.errors import UserError

GAMMA = 0.9


def rollouts(env, steps, count):
    actor = modules.tanh_normal_actor(env, (8,))
    collector = collectors.VectorCollector(env, actor, frames_per_batch=env.num_envs * steps)
    return [collector.rollout() for _ in range(count)]


def hand_made(observations, rewards, terminated=(), truncated=(), finals=None):
    """One env's rollout [1, T]; ``observations`` has T + 1 numbers, ``finals`` the true next observation of a step."""
    steps = len(rewards)
    after = torch.tensor(observations[1:], dtype=torch.float32)
    for t, value in (finals or {}).items():
        after[t] = value
    flag = lambda where: torch.tensor([[t in where] for t in range(steps)])  # noqa: E731
    wide = lambda x: x.reshape(1, steps, 1).expand(1, steps, 3)  # noqa: E731
    return TensorDict(
        {
            "observation": wide(torch.tensor(observations[:-1], dtype=torch.float32)),
            "action": torch.zeros(1, steps, 1),
            "next": {
                "observation": wide(after),
                "reward": torch.tensor(rewards, dtype=torch.float32).reshape(1, steps, 1),
                "terminated": flag(terminated).unsqueeze(0),
                "truncated": flag(truncated).unsqueeze(0),
                "done": (flag(terminated) | flag(truncated)).unsqueeze(0),
            },
        },
        [1, steps],
    )


def kept(buffer):
    """All frames that can be sampled, oldest first."""
    rows = torch.arange(buffer.start, buffer.start + len(buffer)) % buffer.rows
    return buffer.gather(GAMMA)(buffer.data, rows)


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("steps", [1, 7, 60])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_every_frame_kept_is_the_frame_written(num_envs, steps, n_steps):
    env = envs.make("Pendulum-v1", num_envs)
    buffer = data.ReplayBuffer(env, capacity=240, n_steps=n_steps)
    history = rollouts(env, steps, 720 // steps)
    for rollout in history:
        buffer.extend(rollout)
    whole = torch.cat(history, 1)
    batch = kept(buffer)
    assert 240 - (n_steps - 1) * num_envs == len(buffer) == len(batch)
    for k, frame in enumerate(range(buffer.start, buffer.start + len(buffer))):
        t, n = divmod(frame, num_envs)
        assert torch.equal(batch["observation"][k], whole["observation"][n, t])
        assert torch.equal(batch["action"][k], whole["action"][n, t])
        total = 0.0
        for m in range(n_steps):
            total += GAMMA**m * whole["next", "reward"][n, t + m]
            if whole["next", "done"][n, t + m]:
                break
        torch.testing.assert_close(batch["next", "reward"][k], total)
        assert torch.equal(batch["next", "observation"][k], whole["next", "observation"][n, t + m])
        assert batch["next", "done"][k] == whole["next", "done"][n, t + m]


def test_n_steps_stop_at_a_truncation_and_at_a_termination():
    # rewards 1..6; step 1 is truncated (true final observation 50), step 4 terminates (60); n = 3, gamma 0.9:
    # t=0: 1 + 0.9*2 = 2.8, two steps, next 50, not terminated; t=1: 2, one step, next 50
    # t=2: 3 + 0.9*4 + 0.81*5 = 10.65, three steps, next 60, terminated; t=3: 4 + 0.9*5 = 8.5, two steps, the same
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 100, n_steps=3)
    rollout = hand_made([0, 1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 6], {4}, {1}, {1: 50.0, 4: 60.0})
    buffer.extend(rollout)
    batch = kept(buffer)
    torch.testing.assert_close(batch["next", "reward"].squeeze(-1), torch.tensor([2.8, 2.0, 10.65, 8.5]))
    assert batch["steps_to_next_obs"].squeeze(-1).tolist() == [2, 1, 3, 2]
    assert batch["next", "observation"][:, 0].tolist() == [50, 50, 60, 60]
    assert batch["next", "terminated"].squeeze(-1).tolist() == [False, False, True, True]
    assert batch["next", "done"].squeeze(-1).tolist() == [True, True, True, True]


def test_rows_never_written_do_not_reach_a_batch():
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 50, n_steps=3, seed=0)
    for table in (buffer.table.frames, buffer.table.observations):
        for x in table.values():
            if x.dtype.is_floating_point:
                x.fill_(torch.nan)  # what an allocation may hold
    buffer.extend(hand_made([*range(6)], [1.0] * 5, terminated=[2]))
    batch = kept(buffer)
    assert all(x.isfinite().all() for x in batch.values(True, True))


def test_rollouts_that_do_not_continue_one_another_keep_their_next_observations():
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 100)
    buffer.extend(hand_made([0, 1, 2], [1, 1]))
    buffer.extend(hand_made([7, 8, 9], [1, 1]))  # not from 2 on
    batch = kept(buffer)
    assert batch["observation"][:, 0].tolist() == [0, 1, 7, 8]
    assert batch["next", "observation"][:, 0].tolist() == [1, 2, 8, 9]
    assert not batch["next", "done"].any()


def test_of_a_rollout_longer_than_the_capacity_the_end_is_kept():
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 4)
    for _ in range(2):
        buffer.extend(hand_made(list(range(11)), list(range(10))))
        assert kept(buffer)["next", "reward"].squeeze(-1).tolist() == [6, 7, 8, 9]
        assert kept(buffer)["next", "observation"][:, 0].tolist() == [7, 8, 9, 10]


@pytest.mark.parametrize("num_envs", [1, 8])
def test_of_a_rollout_the_last_step_is_kept_where_there_is_room_for_one(num_envs):
    env = envs.make("Pendulum-v1", num_envs)
    buffer = data.ReplayBuffer(env, num_envs)
    for rollout in rollouts(env, 5, 2):
        buffer.extend(rollout)
    assert torch.equal(kept(buffer)["next", "observation"], rollout["next", "observation"][:, -1])


def test_too_many_endings_evict_the_oldest_frames_and_none_is_wrong():
    buffer = data.ReplayBuffer(envs.make("Pendulum-v1"), 64, final_rows=4)
    for start in range(0, 60, 3):
        buffer.extend(hand_made([start, start + 1, start + 2, 0], [1, 1, 1], {2}, finals={2: start + 0.5}))
    batch = kept(buffer)
    assert 0 < len(batch) < 60
    ends = batch["next", "done"].squeeze(-1)
    assert ends.sum() == 4
    assert torch.equal(batch["next", "observation"][ends, 0], batch["observation"][ends, 0] - 1.5)


def test_draws_are_uniform_over_all_frames_and_have_a_generator_of_their_own():
    env = envs.make("Pendulum-v1")
    one, other = (data.ReplayBuffer(env, 50, seed=3) for _ in range(2))
    for rollout in rollouts(env, 20, 4):
        one.extend(rollout)
        other.extend(rollout)
    torch.manual_seed(0)
    drawn = one.sample_index(20, batches=500)
    torch.manual_seed(1)
    assert torch.equal(drawn, other.sample_index(20, batches=500))
    counts = torch.bincount((drawn.flatten() - one.start) % one.rows, minlength=50)
    assert len(counts) == 50 and counts.min() > 120 and counts.max() < 290  # 200 each, deviation 14


def test_memmap_storage_gives_the_same_batches(tmp_path):
    env = envs.make("Pendulum-v1")
    here = data.ReplayBuffer(env, 50, seed=0)
    there = data.ReplayBuffer(env, 50, seed=0, storage=data.in_files(tmp_path))
    for rollout in rollouts(env, 30, 3):
        here.extend(rollout)
        there.extend(rollout)
    assert (here.sample(16) == there.sample(16)).all()


@pytest.mark.parametrize("prioritized", [False, True])
def test_saved_and_loaded_it_goes_on_bit_for_bit(tmp_path, prioritized):
    env = envs.make("Pendulum-v1", 2)
    make = lambda seed: data.ReplayBuffer(env, 60, sampler=data.Prioritized() if prioritized else None, seed=seed)  # noqa: E731
    one, two = make(1), make(2)
    *first, last = rollouts(env, 20, 4)
    for rollout in first:
        one.extend(rollout)
    one.save(tmp_path / "buffer.pt")
    two.load(tmp_path / "buffer.pt")
    for buffer in (one, two):
        buffer.extend(last)
    assert (one.sample(16) == two.sample(16)).all()


def test_refusals(tmp_path):
    pendulum, cheetah, walker = (envs.make(name) for name in ("Pendulum-v1", "HalfCheetah-v5", "Walker2d-v5"))
    buffer = data.ReplayBuffer(pendulum, 50)
    with pytest.raises(UserError, match="batch_size=8 is above the 0 frames stored"):
        buffer.sample(8)
    with pytest.raises(UserError, match=r"made for 2 environments, the rollout's batch size is \(1, 2\)"):
        data.ReplayBuffer(envs.make("Pendulum-v1", 2), 50).extend(hand_made([0, 1, 2], [1, 1]))
    data.ReplayBuffer(cheetah, 50).save(tmp_path / "cheetah.pt")
    with pytest.raises(UserError, match="its environment is HalfCheetah-v5, here it is Walker2d-v5"):
        data.ReplayBuffer(walker, 50).load(tmp_path / "cheetah.pt")  # the shapes are the same
    with pytest.raises(UserError, match="capacity"):
        data.ReplayBuffer(pendulum, 0)
    with pytest.raises(UserError, match="no saved replay buffer"):
        buffer.load(tmp_path / "nothing.pt")


def test_what_a_buffer_held_is_gone_after_a_load(tmp_path):
    env = envs.make("Pendulum-v1")
    few, many = data.ReplayBuffer(env, 60, seed=0), data.ReplayBuffer(env, 60, seed=0)
    batches = list(rollouts(env, 10, 12))
    few.extend(batches[0])
    for rollout in batches[1:]:
        many.extend(rollout)
    many.load_state_dict(few.state_dict())
    for rollout in batches[1:4]:
        few.extend(rollout)
        many.extend(rollout)
    assert len(many) == len(few) == 40
    assert (many.sample(32) == few.sample(32)).all()
    with pytest.raises(UserError, match="its n_steps is 1, here it is 3"):
        data.ReplayBuffer(env, 60, n_steps=3).load_state_dict(few.state_dict())


def test_files_of_two_buffers_in_one_folder_are_apart(tmp_path):
    env = envs.make("Pendulum-v1")
    one, two = (data.ReplayBuffer(env, 50, seed=0, storage=data.in_files(tmp_path / "replay")) for _ in range(2))
    first, second = rollouts(env, 30, 2)
    one.extend(first)
    two.extend(second)
    assert torch.equal(one.table.observations["observation"][:30], first["observation"][0])
    folders = list((tmp_path / "replay").iterdir())
    assert len(folders) == 2 and all(any(folder.iterdir()) for folder in folders)
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be kept in .*file: "):
        data.in_files(tmp_path / "file")


def test_observations_without_dimensions_and_torchrls_environments():
    env = GymEnv("FrozenLake-v1", categorical_action_encoding=True)
    buffer = data.ReplayBuffer(env, 100)
    rollout = env.rollout(40, break_when_any_done=False)
    buffer.extend(rollout)
    batch = buffer.gather(1.0)(buffer.data, torch.arange(40))
    assert torch.equal(batch["observation"], rollout["observation"])
    assert torch.equal(batch["next", "observation"], rollout["next", "observation"])
    several = SerialEnv(2, partial(GymEnv, "Pendulum-v1"))
    assert data.ReplayBuffer(several, 100).env_name == "SerialEnv"


def test_evicted_frames_are_warned_of_once(caplog):
    env = envs.make("Pendulum-v1", num_envs=1)
    buffer = data.ReplayBuffer(env, 16)
    for first in (0, 100, 200):
        buffer.extend(hand_made(list(range(first, first + 20)), [0.0] * 19, truncated=range(19)))
    assert [record.message for record in caplog.records] == [
        "episodes end, or frames do not continue one another, more often than the replay has room for final "
        "observations (2): old frames leave before there are 16; ReplayBuffer(final_rows=...) is that room, as large "
        "as the capacity for frames in no order"
    ]


def test_further_entries_are_kept_and_come_back(tmp_path):
    env = envs.make("Pendulum-v1", num_envs=2, seed=1)
    made = partial(data.ReplayBuffer, env, 20, entries={"action_log_prob": torch.zeros(()), "cost": torch.zeros(2)})
    buffer = made()
    for rollout in rollouts(env, 5, 3):
        rollout["cost"] = rollout["observation"][..., :2].square()
        buffer.extend(rollout)
    batch, actor_log_prob = kept(buffer), rollout["action_log_prob"].T.flatten()
    torch.testing.assert_close(batch["action_log_prob"][-10:], actor_log_prob)
    torch.testing.assert_close(batch["cost"], batch["observation"][:, :2].square())
    buffer.save(tmp_path / "buffer.pt")
    other = made()
    other.load(tmp_path / "buffer.pt")
    assert (kept(other) == batch).all()
    with pytest.raises(UserError, match="its entries is"):
        data.ReplayBuffer(env, 20).load(tmp_path / "buffer.pt")
    with pytest.raises(UserError, match="'reward' is kept anyway"):
        data.ReplayBuffer(env, 20, entries={"reward": torch.zeros(1)})
    with pytest.raises(UserError, match="has no 'cost'"):
        buffer.extend(rollout.exclude("cost"))


def test_until_a_checkpoint_is_written_the_one_before_has_its_file(tmp_path):
    env = envs.make("Pendulum-v1", seed=1)
    buffer, states = data.ReplayBuffer(env, 50), []
    beside = data.BesideCheckpoint(buffer, tmp_path / "buffer.pt", save=True)
    for rollout in rollouts(env, 5, 3):
        buffer.extend(rollout)
        states.append(beside.state_dict())
    assert {path.name for path in tmp_path.iterdir()} == {"buffer.pt", "buffer-2.pt"}
    for state, written in zip(states[1:], (10, 15), strict=True):
        other = data.ReplayBuffer(env, 50)
        data.BesideCheckpoint(other, tmp_path / "buffer.pt", save=True).load_state_dict(state)
        assert other.written == written


def test_a_replay_beyond_memory_is_refused_before_it_is_allocated():
    # 10^12 frames of 17 observations, for an eighth of them finals, 6 actions and the reward in four bytes, two flags
    # and an int64 row: 68 * 9/8 = 76.5 and 24 + 4 + 2 + 8 = 38 bytes
    message = (
        r"1,000,000,000,000 frames takes 114,500.0 GB, 76,500.0 of them for 'observation', and [\d.,]+ GB of memory"
    )
    with pytest.raises(UserError, match=message):
        data.ReplayBuffer(envs.make("HalfCheetah-v5"), 10**12)


@pytest.mark.fault(
    kind=14,
    injected="a saved replay that is cut, empty, something else, or has one of 25 bits flipped",
    outcome="one line; nothing of it is loaded",
)
@pytest.mark.parametrize("damage", ["cut", "empty", "no buffer", "text", "bits"])
def test_damaged_files_are_one_line(tmp_path, damage):
    path, buffer = tmp_path / "buffer.pt", data.ReplayBuffer(envs.make("Pendulum-v1"), 50)
    buffer.save(path)
    content = path.read_bytes()
    if damage == "no buffer":
        torch.save({"made_for": buffer.state_dict()["made_for"]}, path)
    elif damage == "bits":
        for bit in torch.randint(8 * len(content), (25,), generator=torch.Generator().manual_seed(0)).tolist():
            path.write_bytes(content[: bit // 8] + bytes([content[bit // 8] ^ 1 << bit % 8]) + content[bit // 8 + 1 :])
            with pytest.raises(UserError, match="its hash does not fit"):
                buffer.load(path)
    else:
        path.write_bytes({"cut": content[: len(content) // 2], "empty": b"", "text": b"hello"}[damage])
    with pytest.raises(UserError, match="is damaged|is no saved replay buffer") as error:
        buffer.load(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("steps", [1, 40])
@pytest.mark.parametrize("prioritized", [False, True])
def test_frames_that_a_mask_leaves_out_are_never_drawn(num_envs, steps, prioritized):
    """CartPole pays 1 for every step; a row whose action Gymnasium ignores, since it resets, is no step and pays 0."""

    def make():
        return data.ReplayBuffer(env, 150, sampler=data.Prioritized() if prioritized else None, seed=0)

    env = envs.make(gym.make_vec("CartPole-v1", num_envs=num_envs), seed=1)
    buffer, again = make(), make()
    actor, frames = modules.categorical_actor(env), num_envs * steps
    collector = collectors.VectorCollector(env, actor, frames_per_batch=frames, compile="off")
    masks = []
    for _ in range(240 // steps):
        rollout = collector.rollout()
        masks.append(rollout["collector", "mask"])
        buffer.extend(rollout)
    assert (~torch.cat(masks, 1)[:, -150 // num_envs :]).any()  # there are some
    again.load_state_dict(buffer.state_dict())
    for one in (buffer, again):
        for _ in range(20):
            assert (one.sample(len(one))["next", "reward"] == 1).all()


def test_what_comes_to_the_cpu_is_waited_for(monkeypatch):
    """A copy from a GPU that nobody waits for is read before it is there: the CPU holds the frames then."""
    buffer, moved, to = data.ReplayBuffer(envs.make("Pendulum-v1"), 10), [], torch.Tensor.to
    monkeypatch.setattr(torch.Tensor, "to", lambda x, *args, **given: moved.append(given) or to(x, *args, **given))
    buffer.extend(hand_made([0, 1, 2], [1, 1]))
    assert moved and not any(given.get("non_blocking") for given in moved)
