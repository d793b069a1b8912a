import torch
from tensordict import TensorDict

from pgkit import data


def rollout(number):
    return TensorDict({"x": torch.full((2, 3), float(number))}, [2, 3])


def test_newest_first_and_never_another_shape():
    recent = data.Recent(3)
    for number, expected in ((1, [1, 1, 1]), (2, [2, 1, 1]), (3, [3, 2, 1]), (4, [4, 3, 2])):
        batch = recent(rollout(number))
        assert batch.shape == (6, 3) and batch["x"][::2, 0].tolist() == expected
        batch["x"].zero_()  # what is written into it is not kept


def test_state_travels():
    recent, again = data.Recent(2), data.Recent(2)
    recent(rollout(1))
    again.load_state_dict(recent.state_dict())
    assert torch.equal(again(rollout(2))["x"], recent(rollout(2))["x"])


def test_rollouts_that_a_checkpoint_brought_to_the_cpu_go_where_the_newest_is():
    recent = data.Recent(2)
    recent.load_state_dict({"kept": [rollout(1), rollout(2)]})
    assert recent(rollout(3).to("meta"))["x"].device.type == "meta"
