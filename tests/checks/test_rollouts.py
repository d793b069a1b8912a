"""Rows of a rollout that do not follow each other are found by what the networks read, wherever that lies."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from pgkit import losses
from pgkit.checks import LossView, device_of
from pgkit.checks.rollouts import check_order
from pgkit.errors import UserError

AGENTS = ("agents", "observation")


class Add(nn.Module):
    """One number for all inputs, and a deviation of 1."""

    def __init__(self, outputs=1):
        super().__init__()
        self.weight, self.outputs = nn.Parameter(torch.ones(())), outputs

    def forward(self, *inputs):
        total = self.weight * sum(x.float().mean(-1, keepdim=True) for x in inputs)
        return total if self.outputs == 1 else (total, torch.ones_like(total))


def view_of(*keys):
    net = TensorDictModule(Add(2), list(keys), ["loc", "scale"])
    actor = ProbabilisticActor(net, ["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True)
    critic = TensorDictModule(Add(), list(keys), ["state_value"])
    return LossView(losses.ClipPPOLoss(actor, critic), advantage=lambda rollout: rollout)


def rollout_of(**observations):
    """Two environments, four steps; step t of environment n observes ``10 n + t`` and leads to the next."""
    time = torch.arange(4.0).expand(2, 4) + torch.tensor([[0.0], [10.0]])
    now = {name: time.reshape(2, 4, *[1] * len(size)).expand(2, 4, *size) for name, size in observations.items()}
    done = torch.zeros(2, 4, 1, dtype=torch.bool)
    after = {name: x + 1 for name, x in now.items()}
    data = TensorDict({**now, "next": {**after, "reward": done.float(), "done": done}}, [2, 4])
    return data.clone()


def test_a_rollout_in_order_passes():
    check_order(view_of("observation"), rollout_of(observation=(3,)))
    check_order(view_of("observation"), rollout_of(observation=(3,))[:, :1])
    check_order(view_of("observation"), rollout_of(observation=(3,))[1])


@pytest.mark.fault(
    kind=34,
    injected="rollouts that are shuffled, stitched, flattened, or have time first",
    outcome="the first look names the step that does not begin where the one before led",
)
@pytest.mark.parametrize(
    ("wrong", "where"),
    [
        (lambda r: r[:, [0, 1, 3, 2]], "in row 0, step 2 does not begin where step 1 led"),
        (lambda r: torch.cat([r[:1], r[1:, [0, 2, 1, 3]]]), "in row 1, step 1 does not begin where step 0 led"),
        (lambda r: torch.cat([r[:, :2], r[:, :2]], 1), "in row 0, step 2 does not"),  # stitched
        (lambda r: r.transpose(0, 1).contiguous(), "in row 0, step 1 does not"),  # time first
        (lambda r: r.reshape(-1), r"the rollout of batch size \[8\] is not one environment's: step 4 does not begin"),
    ],
)
def test_rows_that_are_no_successors_are_found(wrong, where):
    with pytest.raises(UserError, match=where):
        check_order(view_of("observation"), wrong(rollout_of(observation=(3,))))


def test_a_rollout_need_not_say_where_its_tensors_are():
    rollout = rollout_of(observation=(3,)).apply(lambda x: x.to("meta"))
    assert rollout.device is None and device_of(rollout).type == "meta"
    check_order(view_of("another"), rollout)  # meta tensors have no values to compare


def test_what_ends_an_episode_or_does_not_count_may_lead_anywhere():
    rollout = rollout_of(observation=(3,))[:, [0, 1, 3, 2]]  # breaks after steps 1 and 2
    with pytest.raises(UserError, match="step 2 does"):
        check_order(view_of("observation"), rollout)
    rollout["next", "done"][:, 1] = True
    with pytest.raises(UserError, match="step 3 does"):
        check_order(view_of("observation"), rollout)
    rollout["collector", "mask"] = torch.tensor([True, True, True, False]).expand(2, 4)
    check_order(view_of("observation"), rollout)


def test_one_nan_is_as_good_as_another_and_no_number():
    rollout = rollout_of(observation=(3,))
    rollout["observation"][0, 2, 1] = rollout["next", "observation"][0, 1, 1] = float("nan")
    check_order(view_of("observation"), rollout)
    rollout["next", "observation"][0, 1, 1] = 2.0
    with pytest.raises(UserError, match="step 2 does"):
        check_order(view_of("observation"), rollout)


def test_every_observation_is_compared_images_and_flat_numbers_too():
    view = view_of("image", "count")
    rollout = rollout_of(image=(1, 2, 2), count=())
    for key in ("image", ("next", "image")):
        rollout[key] = rollout[key].to(torch.uint8)
    check_order(view, rollout)
    rollout["count"][1, 2] = 7
    with pytest.raises(UserError, match=r"in row 1, step 2 does not begin where step 1 led \('count'\)"):
        check_order(view, rollout)
    rollout["count"][1, 2] = 12
    rollout["image"][0, 3, 0, 1, 1] += 1
    with pytest.raises(UserError, match=r"in row 0, step 3 does not begin where step 2 led \('image'\)"):
        check_order(view, rollout)


@pytest.mark.parametrize("done", [("next", "done"), ("next", "agents", "done")])
def test_a_group_of_agents_is_compared_and_may_end_at_the_root_or_in_the_group(done):
    rollout = rollout_of(observation=(3, 5))  # three agents
    rollout["agents"] = TensorDict({"observation": rollout.pop("observation")}, [2, 4, 3])
    after = rollout["next"]
    after["agents"] = TensorDict({"observation": after.pop("observation")}, [2, 4, 3])
    check_order(view_of(AGENTS), rollout)
    for key in (AGENTS, ("next", *AGENTS)):
        rollout[key][0, 2:, 1] += 1  # of one agent, from step 2 on
    with pytest.raises(UserError, match=r"step 2 does not begin where step 1 led \('agents.observation'\)"):
        check_order(view_of(AGENTS), rollout)
    flags = torch.zeros(2, 4, *([3, 1] if "agents" in done else [1]), dtype=torch.bool)
    flags[0, 1] = True
    check_order(view_of(AGENTS), rollout.set(done, flags))
