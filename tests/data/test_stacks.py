"""Stacks of frames, stored once, against the stacks that were written."""

from collections import deque

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded

from pgkit import data, envs
from pgkit.compiled.native import compile_record, record
from pgkit.errors import UserError


class Pixels:
    """Numbers that are written: frames ``[C, 2, 2]`` of a counter, stacked ``k`` times, one environment a column."""

    def __init__(self, columns, k=3, channels=2, endings=(), begin=0, pad="repeat"):
        self.columns, self.k, self.channels, self.endings, self.pad = columns, k, channels, endings, pad
        self.count, self.time = begin, 0
        self.stacks = [self.fresh(n) for n in range(columns)]

    def frame(self, n):
        self.count += 1
        return torch.arange(4 * self.channels, dtype=torch.uint8).view(self.channels, 2, 2) + self.count * 7 + n

    def fresh(self, n):
        first = self.frame(n)
        before = first if self.pad == "repeat" else torch.zeros_like(first)
        return deque([*[before] * (self.k - 1), first], maxlen=self.k)

    def observation(self):
        return torch.stack([torch.cat(list(stack)) for stack in self.stacks])

    def rollout(self, steps):
        out = []
        for _ in range(steps):
            self.time += 1
            step = {"pixels": self.observation(), "position": torch.full((self.columns, 1), float(self.time))}
            for n, stack in enumerate(self.stacks):
                stack.append(self.frame(n))
            done = torch.tensor([[(n, self.time) in self.endings] for n in range(self.columns)])
            step |= {
                "action": torch.full((self.columns, 1), float(self.time)),
                "next": {
                    "pixels": self.observation(),
                    "position": torch.full((self.columns, 1), self.time + 1.0),
                    "reward": torch.full((self.columns, 1), float(self.time)),
                    "terminated": done,
                    "done": done,
                },
            }
            for n in done.squeeze(1).nonzero():
                self.stacks[n] = self.fresh(int(n))
            out.append(TensorDict(step, [self.columns]))
        return torch.stack(out, 1)


@pytest.fixture
def env():
    return made(2)


def made(columns, k=3, channels=2):
    env = envs.make("Pendulum-v1", columns)
    pixels = Bounded(0, 255, (columns, k * channels, 2, 2), dtype=torch.uint8)
    env.observation_spec = Composite(pixels=pixels, position=Unbounded((columns, 1)), shape=(columns,))
    return env


def replay(env, capacity=40, **settings):
    return data.ReplayBuffer(env, capacity, frame_stack={"pixels": 3}, seed=0, **settings)


def assert_kept_as_written(buffer, history, columns, n_steps=1):
    whole = torch.cat(history, 1)
    frames = torch.arange(buffer.start, buffer.start + len(buffer))
    batch = buffer.gather(1.0)(buffer.data, frames % buffer.rows)
    for i, frame in enumerate(frames.tolist()):
        t, n = divmod(frame, columns)
        for m in range(n_steps):
            if whole["next", "done"][n, t + m]:
                break
        for key in ("pixels", "position"):
            assert torch.equal(batch[key][i], whole[key][n, t]), (key, t, n)
            assert torch.equal(batch["next", key][i], whole["next", key][n, t + m]), ("next", key, t, n)


ENDINGS = {(0, 1), (1, 4), (0, 5), (0, 6), (1, 17), (0, 30), (1, 31), (0, 44), (1, 60)}


@pytest.mark.parametrize("steps", [1, 2, 15, 60])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_every_stack_is_the_stack_written(env, steps, n_steps):
    simulator = Pixels(2, endings=ENDINGS)
    buffer, history = replay(env, n_steps=n_steps, final_rows=20), []
    for _ in range(60 // steps):
        rollout = simulator.rollout(steps)
        buffer.extend(rollout)
        history.append(rollout[:, -22:])  # of a longer one, 20 steps and the frames of their stacks
        assert_kept_as_written(buffer, history, 2, n_steps)
    assert len(buffer) == 40 - 2 * (n_steps - 1)


@pytest.mark.parametrize("pad", ["repeat", "zeros"])
def test_rollouts_from_the_middle_of_episodes_keep_their_stacks(env, pad):
    several = [Pixels(2, endings=ENDINGS, begin=100 * i, pad=pad) for i in range(3)]
    several[0].rollout(7)  # nobody stored these
    buffer, history = replay(env, final_rows=60), []
    for steps in (1, 4, 2, 1, 1, 6, 3):
        for simulator in several:
            history.append(simulator.rollout(steps))
            buffer.extend(history[-1])
            assert_kept_as_written(buffer, history, 2)


def test_where_there_is_no_room_for_old_frames_stacks_leave_and_none_is_wrong(env):
    several = [Pixels(2, begin=100 * i) for i in range(2)]
    buffer, history = replay(env, final_rows=9), []
    for _ in range(12):
        for simulator in several:
            history.append(simulator.rollout(3))
            buffer.extend(history[-1])
            assert_kept_as_written(buffer, history, 2)
    assert 0 < len(buffer) < 20


def test_stacks_of_several_sizes():
    env = made(1)
    spec = env.observation_spec.clone()
    spec["other"] = Unbounded((1, 2, 1))
    env.observation_spec = spec
    buffer = data.ReplayBuffer(env, 20, frame_stack={"pixels": 3, "other": 2}, final_rows=20)
    simulator, history = Pixels(1, endings={(0, 3), (0, 9)}), []
    for _ in range(14):
        rollout = simulator.rollout(2)
        for place in (rollout, rollout["next"]):
            place["other"] = place["pixels"][..., -4:, 0, 0].view(1, 2, 2, 2)[..., :1].float().flatten(-2).unsqueeze(-1)
        history.append(rollout)
        buffer.extend(rollout)
    whole = torch.cat(history, 1)
    frames = torch.arange(buffer.start, buffer.start + len(buffer))
    batch = buffer.gather(1.0)(buffer.data, frames % buffer.rows)
    for key in ("pixels", "other", ("next", "pixels"), ("next", "other")):
        assert torch.equal(batch[key], whole[key][0, frames]), key
    assert buffer.table.observations["other"].shape[1:] == (1, 1)


def test_what_is_stored_takes_the_bytes_of_single_frames():
    env, capacity = made(1, channels=3), 2_000
    buffer = replay(env, capacity)
    taken = sum(x.numel() * x.element_size() for x in buffer.table.observations.values() if x.ndim == 4)
    assert taken <= 1.1 * capacity * 12  # 3 channels of 2 x 2 bytes


def test_compiled_it_gathers_the_same(env):
    simulator, buffer = Pixels(2, endings=ENDINGS), replay(env, n_steps=1, final_rows=20)
    for _ in range(6):
        buffer.extend(simulator.rollout(10))
    keys = list(buffer.data.keys(True, True))

    def gathered(*inputs):
        rows = buffer.data.copy()
        for key, x in zip(keys, inputs[:-1], strict=True):
            rows.set(key, x)
        batch = buffer.gather(1.0)(rows, inputs[-1])
        return [batch[key] for key in ("pixels", ("next", "pixels"))]

    index = buffer.sample_index(16)[0]
    inputs = [*(buffer.data[key] for key in keys), index]
    code = compile_record(record(gathered, inputs), inputs)
    for index in buffer.sample_index(16, 3):
        expected = buffer.gather(1.0)(buffer.data, index)
        for got, key in zip(code([*inputs[:-1], index]), ("pixels", ("next", "pixels")), strict=True):
            assert torch.equal(got, expected[key])


@pytest.mark.parametrize("prioritized", [False, True])
def test_saved_and_loaded_it_goes_on_bit_for_bit(env, tmp_path, prioritized):
    simulator = Pixels(2, endings=ENDINGS)
    make = lambda: replay(env, sampler=data.Prioritized() if prioritized else None)  # noqa: E731
    one, two = make(), make()
    for _ in range(3):
        one.extend(simulator.rollout(11))
    one.save(tmp_path / "buffer.pt")
    two.load(tmp_path / "buffer.pt")
    rollout = simulator.rollout(3)
    for buffer in (one, two):
        buffer.extend(rollout)
    assert (one.sample(16) == two.sample(16)).all()
    with pytest.raises(UserError, match="its observation is .*, here it is"):
        data.ReplayBuffer(env, 40).load(tmp_path / "buffer.pt")


def test_the_environment_says_what_is_stacked(env):
    env.frame_stack = {"pixels": 3}
    assert data.ReplayBuffer(env, 40).table.observations["pixels"].shape[1:] == (2, 2, 2)


@pytest.mark.parametrize(
    ("stack", "capacity", "message"),
    [
        ({"pixels": 4}, 40, r"'pixels' is \(6, 2, 2\), which is no stack of 4 frames along the first dimension"),
        ({"pixel": 3}, 40, "there is no 'pixel', the observations are pixels, position"),
        (3, 40, "frame_stack=3: say of which of pixels, position, as a dict"),
        ({"pixels": 0}, 40, "give a whole number, at least 1"),
        ({"pixels": 3}, 4, r"a stack of 3 frames \('pixels'\) is longer than the 2 steps that the replay keeps"),
    ],
)
def test_refusals(env, stack, capacity, message):
    with pytest.raises(UserError, match=message):
        data.ReplayBuffer(env, capacity, frame_stack=stack)
