"""Advantages of token rows, by hand; what is outside the completion must not count."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from pgkit import advantages
from pgkit.errors import UserError

# two groups of two rows; completions of 1, 2, 2 and 1 tokens after a prompt token
MASK = torch.tensor([[0, 1, 0], [0, 1, 1], [0, 1, 1], [0, 1, 0]]).bool()


def rollout(*rewards):
    log_prob = torch.tensor([[9.0, -1, 9], [9, -1, -2], [9, -1, -2], [9, -3, 9]])
    reference = torch.tensor([[7.0, -1.5, 7], [7, -1, -1], [7, -1, -2], [7, -3, 7]])
    return TensorDict(
        {
            "masks": {"all_assistant_mask": MASK.clone()},
            "log_probs": {"full": log_prob},
            "next": {"reward": torch.tensor(rewards).unsqueeze(-1), "ref_log_probs": {"full": reference}},
        },
        [4],
    )


@pytest.mark.parametrize(
    ("kind", "expected"),
    [  # rewards 1, 3 | 5, 5
        ("group", [-(0.5**0.5), 0.5**0.5, 0, 0]),  # deviation of 1 and 3: sqrt 2
        ("mean", [-1, 1, 0, 0]),
        ("leave_one_out", [-2, 2, 0, 0]),
        ("batch", [-1 / (11 / 3) ** 0.5, 1 / (11 / 3) ** 0.5, 0, 0]),  # squares from 3.5: 6.25 .25 2.25 2.25
    ],
)
def test_kinds(kind, expected):
    out = advantages.GroupRelative(2, kind=kind)(rollout(1.0, 3.0, 5.0, 5.0))
    expected = torch.tensor(expected, dtype=torch.float32).unsqueeze(-1) * MASK
    torch.testing.assert_close(out["advantage"], expected.unsqueeze(-1), rtol=1e-5, atol=1e-5)
    assert torch.equal(out["value_target"].squeeze(-1), torch.tensor([[1.0], [3], [5], [5]]) * MASK)
    assert torch.equal(out["masks", "all_assistant_mask"], MASK)


def test_groups_without_spread_leave_the_batch():
    out = advantages.GroupRelative(2, drop=True)(rollout(5.0, 5.0, 1.0, 3.0))
    assert out.shape == (2,) and out["next", "reward"].flatten().tolist() == [1, 3]
    assert torch.equal(out["masks", "all_assistant_mask"], MASK[2:])
    torch.testing.assert_close(out["advantage"][:, 1, 0], torch.tensor([-(0.5**0.5), 0.5**0.5]), rtol=1e-5, atol=1e-5)


def test_rows_without_spread_fill_up_a_minibatch():
    for rewards, live in ((5.0, 5.0, 1.0, 3.0), [2, 3]), ((5.0, 5.0, 5.0, 5.0), []):
        out = advantages.GroupRelative(2, drop=True, multiple=4)(rollout(*rewards))
        assert out.shape == (4,)  # live rows first
        first, rest = out[: len(live)], out[len(live) :]
        assert torch.equal(first["masks", "all_assistant_mask"], MASK[live])
        assert not rest["masks", "all_assistant_mask"].any() and not rest["log_probs", "full"].any()
        assert not rest["advantage"].any()
    least = advantages.GroupRelative(2, drop=True)(rollout(5.0, 5.0, 1.0, 1.0))
    assert least.shape == (2,) and not least["masks", "all_assistant_mask"].any()


def test_divergence_off_the_reward():
    # log pi - log ref: .5 in the first row, 0 - 1 in the second, nothing in the others: rewards less a half of that
    out = advantages.GroupRelative(2, kind="mean", kl_coeff=0.5)(rollout(1.0, 3.0, 5.0, 5.0))
    half = (3.5 - 0.75) / 2
    expected = torch.tensor([-half, half, 0, 0]).unsqueeze(-1) * MASK
    torch.testing.assert_close(out["advantage"].squeeze(-1), expected)
    # k2: .125 and .5
    out = advantages.GroupRelative(2, kind="mean", kl_coeff=2.0, kl="k2")(rollout(1.0, 3.0, 5.0, 5.0))
    half = (2.0 - 0.75) / 2
    torch.testing.assert_close(out["advantage"][1, 2, 0].item(), half)


def test_what_does_not_fit():
    with pytest.raises(UserError, match="group_size=1: an attempt is measured against others, give at least 2"):
        advantages.GroupRelative(1)
    with pytest.raises(UserError, match="kind='median': give group, mean, leave_one_out, batch"):
        advantages.GroupRelative(2, kind="median")
    with pytest.raises(ValueError, match=r"scores of shape \(4,\) are not groups of 3"):
        advantages.GroupRelative(3)(rollout(1.0, 3.0, 5.0, 5.0))
    wrong = rollout(1.0, 3.0, 5.0, 5.0)
    wrong["next", "reward"] = torch.zeros(4, 3, 1)
    with pytest.raises(
        UserError, match=r"the reward of 4 completions has shape \(4, 3, 1\): give one number each, \(4, 1\)"
    ):
        advantages.GroupRelative(2)(wrong)


def test_gae_over_tokens():
    # values .5 .25 | reward 1 with the second token: delta_2 = 1 - .25 = .75, delta_1 = .5 (gamma) * .25 - .5 = -.375,
    # A_1 = -.375 + .5 * .5 (lambda) * .75 = -.1875; of one token of value .5 and reward 2: A = 1.5
    values = torch.tensor([[9, 0.5, 0.25], [9, 0.5, 9]]).unsqueeze(-1)
    critic = TensorDictModule(lambda tokens: values, in_keys=[("tokens", "full")], out_keys=["state_value"])
    mask = torch.tensor([[0, 1, 1], [0, 1, 0]]).bool()
    data = TensorDict(
        {
            "tokens": {"full": torch.zeros(2, 3, dtype=torch.int64)},
            "masks": {"all_assistant_mask": mask},
            "next": {"reward": torch.tensor([[1.0], [2.0]])},
        },
        [2],
    )
    out = advantages.TokenGAE(critic, gamma=0.5, lmbda=0.5)(data)
    raw = torch.tensor([-0.1875, 0.75, 1.5])
    torch.testing.assert_close(out["value_target"].squeeze(-1)[mask], raw + torch.tensor([0.5, 0.25, 0.5]))
    torch.testing.assert_close(out["advantage"].squeeze(-1)[mask], (raw - raw.mean()) / raw.std())
    assert out["advantage"].squeeze(-1)[~mask].eq(0).all() and out["value_target"].squeeze(-1)[~mask].eq(0).all()
