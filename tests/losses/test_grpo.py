"""GRPO: each variant's formula by hand, a float64 loop, TorchRL's loss; what is outside the mask must not count."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives.llm import GRPOLoss as TorchRLGRPOLoss

from pgkit import collectors, envs, losses, modules
from pgkit.errors import UserError
from pgkit.modules.tokens import ATTENTION, COMPLETION, LOG_PROBS, TOKENS, TokenDistribution

NAN = float("nan")
REFERENCE = ("next", "ref_log_probs", "full")


class Table(TensorDictModuleBase):
    """Logits that are parameters, one a token of the batch."""

    in_keys = [TOKENS, ATTENTION, COMPLETION]  # pyright: ignore[reportAssignmentType]
    out_keys = [LOG_PROBS]  # pyright: ignore[reportAssignmentType]

    def __init__(self, rows, length, vocab):
        super().__init__()
        torch.manual_seed(0)
        self.logits = torch.nn.Parameter(torch.randn(rows, length - 1, vocab, dtype=torch.float64))

    def get_dist(self, batch, logits_key=None):
        return TokenDistribution(self.logits, batch[COMPLETION])


def batch(actor, ratios, advantages, reference=None):
    """Rows whose tokens have these ratios; None is outside the completion, where everything is NaN or nonsense."""
    mask = torch.tensor([[r is not None for r in row] for row in ratios])
    rows, length = mask.shape
    data = TensorDict(
        {
            "tokens": {"full": torch.randint(3, (rows, length))},
            "masks": {"all_attention_mask": torch.ones_like(mask), "all_assistant_mask": mask},
        },
        [rows],
    )
    log_prob = actor.get_dist(data).log_prob(data[TOKENS]).detach()
    log_ratio = torch.tensor([[NAN if r is None else math.log(r) for r in row] for row in ratios], dtype=torch.float64)
    data[LOG_PROBS] = log_prob - log_ratio
    advantage = torch.tensor(advantages, dtype=torch.float64).unsqueeze(-1) * torch.where(mask, 1.0, 0.0)
    data["advantage"] = torch.where(mask, advantage, 77.0).unsqueeze(-1)
    if reference is not None:
        d = torch.tensor([[NAN if x is None else x for x in row] for row in reference], dtype=torch.float64)
        data[REFERENCE] = log_prob + d
    return data


# after a prompt token: one token of ratio 1.5 and advantage 2; two of .5 and 1.1, advantage -1; a row that was dropped
RATIOS = [[None, 1.5, None, None], [None, 0.5, 1.1, None], [None] * 4]
ADVANTAGES = [2.0, -1.0, 5.0]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        # min(r A, clip(r, .8, 1.2) A): 2.4 | -.8, -1.1
        ({}, -(2.4 - 0.8 - 1.1) / 3),
        ({"aggregation": "sequence"}, -(2.4 + (-0.8 - 1.1) / 2) / 2),
        ({"aggregation": "constant"}, -(2.4 - 0.8 - 1.1) / (2 * 4)),
        ({"aggregation": "constant", "max_length": 10}, -(2.4 - 0.8 - 1.1) / (2 * 10)),
        ({"aggregation": "prompt_mean"}, -(2.4 + (-0.8 - 1.1) / 2) / 2),
        # 1.5 is in the range up to 1.6: 3
        ({"clip_epsilon": (0.2, 0.6)}, -(3.0 - 0.8 - 1.1) / 3),
        ({"clip_epsilon": (0.6, 0.2)}, -(2.4 - 0.5 - 1.1) / 3),
        # the second row's ratio is sqrt(.5 * 1.1) = .7416 at both tokens, clipped to .8
        ({"ratio": "sequence"}, -(2.4 - 0.8 - 0.8) / 3),
        ({"ratio": "sequence", "aggregation": "sequence"}, -(2.4 - 0.8) / 2),
        ({"ratio": "sequence", "clip_epsilon": 0.5}, -(3.0 - 2 * math.sqrt(0.55)) / 3),
        # without a clip: 3 | -.5, -1.1
        ({"surrogate": lambda log_ratio, advantage: log_ratio.exp() * advantage}, -(3.0 - 0.5 - 1.1) / 3),
    ],
)
def test_objectives(settings, expected):
    actor = Table(3, 4, 3)
    loss = losses.GRPOLoss(actor, **settings)
    out = loss(batch(actor, RATIOS, ADVANTAGES))
    assert out["loss_objective"].item() == pytest.approx(expected, rel=1e-6)
    (gradient,) = torch.autograd.grad(out["loss_objective"], actor.logits)
    assert gradient[2].eq(0).all() and gradient[0, 1:].eq(0).all() and gradient[1, 2].eq(0).all()
    assert gradient.isfinite().all() and set(out.keys()) == set(loss.out_keys)


@pytest.mark.parametrize(
    ("kind", "first", "second", "third"),
    [  # d = log pi_ref - log pi of .5 | -.5, 0
        ("k1", -0.5, 0.5, 0.0),
        ("k2", 0.125, 0.125, 0.0),
        ("k3", math.exp(0.5) - 1.5, math.exp(-0.5) - 0.5, 0.0),
    ],
)
def test_divergences(kind, first, second, third):
    actor = Table(3, 4, 3)
    data = batch(actor, RATIOS, ADVANTAGES, [[None, 0.5, None, None], [None, -0.5, 0, None], [None] * 4])
    expected = {
        "token": (first + second + third) / 3,
        "sequence": (first + (second + third) / 2) / 2,
        "constant": (first + second + third) / 8,
    }
    for aggregation, value in expected.items():
        out = losses.GRPOLoss(actor, kl_to_ref_coeff=0.1, kl=kind, aggregation=aggregation)(data)
        assert out["loss_kl_to_ref"].item() == pytest.approx(0.1 * value)
        assert out["kl_to_ref"].item() == pytest.approx(expected["token"])
        (gradient,) = torch.autograd.grad(out["loss_kl_to_ref"], actor.logits)
        assert gradient.isfinite().all() and gradient[2].eq(0).all() and gradient[0, 1:].eq(0).all()


def test_k1_as_a_loss_ignores_the_reference():
    actor = Table(3, 4, 3)
    gradients = []
    for shift in (0.5, 3.0):
        data = batch(actor, RATIOS, ADVANTAGES, [[shift] * 4] * 3)
        torch.manual_seed(0)
        data[TOKENS].fill_(1)
        data[REFERENCE] = actor.get_dist(data).log_prob(data[TOKENS]).detach() + shift
        out = losses.GRPOLoss(actor, kl_to_ref_coeff=1.0, kl="k1")(data)
        gradients.append(torch.autograd.grad(out["loss_kl_to_ref"], actor.logits)[0])
    torch.testing.assert_close(*gradients)


def test_metrics():
    actor = Table(3, 4, 3)
    out = losses.GRPOLoss(actor, entropy_coeff=0.5)(batch(actor, RATIOS, ADVANTAGES))
    # outside [.8, 1.2]: 1.5 and .5; k3 of the ratios: r - 1 - log r
    assert out["clip_fraction"].item() == pytest.approx(2 / 3)
    assert out["kl_approx"].item() == pytest.approx(sum(r - 1 - math.log(r) for r in (1.5, 0.5, 1.1)) / 3)
    assert out["ESS"].item() == pytest.approx(3.1**2 / (2.25 + 0.25 + 1.21) / 3)
    p = actor.logits.softmax(-1)
    entropy = -(p * p.log()).sum(-1)
    mean = (entropy[0, 0] + entropy[1, 0] + entropy[1, 1]) / 3
    torch.testing.assert_close(out["entropy"], mean.detach())
    torch.testing.assert_close(out["loss_entropy"], -0.5 * mean)


def test_the_first_step_has_loss_0_and_a_gradient():
    actor = Table(2, 3, 3)
    out = losses.GRPOLoss(actor, aggregation="sequence")(batch(actor, [[None, 1, 1], [None, 1, 1]], [1.0, -1.0]))
    assert out["loss_objective"].item() == pytest.approx(0, abs=1e-12)
    assert torch.autograd.grad(out["loss_objective"], actor.logits)[0].abs().max() > 0.01


def test_a_batch_of_dropped_groups_teaches_nothing():
    actor = Table(2, 3, 3)
    out = losses.GRPOLoss(actor)(batch(actor, [[None] * 3] * 2, [1.0, -1.0]))
    assert all(out[key].item() == 0 for key in out.keys())


def loop(actor, data, ratio, aggregation, low, high, beta):
    """The loss, written as the papers' sums."""
    terms, lengths = [], []
    log_p = actor.logits.log_softmax(-1)
    for i in range(len(data)):
        tokens = [t for t in range(1, data[TOKENS].shape[1]) if data[COMPLETION][i, t]]
        now = {t: log_p[i, t - 1, data[TOKENS][i, t]] for t in tokens}
        log_ratio = {t: now[t] - data[LOG_PROBS][i, t] for t in tokens}
        if ratio == "sequence":
            mean = sum(log_ratio.values()) / len(tokens)
            log_ratio = dict.fromkeys(tokens, mean)
        row = []
        for t in tokens:
            r, a, d = log_ratio[t].exp(), data["advantage"][i, t, 0], data[REFERENCE][i, t] - now[t]
            surrogate = torch.minimum(r * a, r.clamp(1 - low, 1 + high) * a)
            row.append(-surrogate + beta * (d.exp() - d - 1))
        terms.append(row)
        lengths.append(len(tokens))
    if aggregation == "token":
        return sum(map(sum, terms)) / sum(lengths)
    if aggregation == "sequence":
        return sum(sum(row) / n for row, n in zip(terms, lengths, strict=True)) / len(terms)
    return sum(map(sum, terms)) / (len(terms) * data[TOKENS].shape[1])


def random_batch(actor, rows=7, length=6):
    torch.manual_seed(1)
    ends = torch.randint(2, length + 1, (rows,)).tolist()
    ratios = [[None if t < 1 or t >= end else math.exp(0.4 * torch.randn(())) for t in range(length)] for end in ends]
    reference = [[None if r is None else float(torch.randn(())) for r in row] for row in ratios]
    return batch(actor, ratios, torch.randn(rows).tolist(), reference)


@pytest.mark.parametrize("ratio", ["token", "sequence"])
@pytest.mark.parametrize("aggregation", ["token", "sequence", "constant"])
def test_a_float64_loop(ratio, aggregation):
    actor = Table(7, 6, 3)
    data = random_batch(actor)
    loss = losses.GRPOLoss(actor, ratio=ratio, aggregation=aggregation, clip_epsilon=(0.125, 0.25), kl_to_ref_coeff=0.5)
    out = loss(data)
    mine = out["loss_objective"] + out["loss_kl_to_ref"]
    expected = loop(actor, data, ratio, aggregation, 0.125, 0.25, 0.5)
    torch.testing.assert_close(mine, expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(
        *(torch.autograd.grad(x, actor.logits)[0] for x in (mine, expected)), rtol=1e-10, atol=1e-10
    )


def language_model():
    torch.manual_seed(0)
    env = envs.prompts("addition", 4, seed=1)
    actor = modules.causal_lm(env, width=32)
    rollout = collectors.TokenCollector(env, actor, group_size=4).rollout()
    mask = rollout[COMPLETION]
    rollout[LOG_PROBS] = rollout[LOG_PROBS] + 0.3 * torch.randn(mask.shape) * mask
    rollout[REFERENCE] = rollout[LOG_PROBS] + 0.3 * torch.randn(mask.shape) * mask
    rollout["advantage"] = (torch.randn(16, 1) * mask).unsqueeze(-1)
    return actor, rollout


@pytest.mark.parametrize("aggregation", ["token_mean", "prompt_mean"])
def test_torchrl_s_loss(aggregation):
    actor, data = language_model()
    settings = {"clip_epsilon": (0.2, 0.28), "aggregation": aggregation, "entropy_coeff": 0.05}
    results = []
    for kind in (losses.GRPOLoss, TorchRLGRPOLoss):
        out = TensorDict(kind(actor, **settings)(data.clone()).to_dict())
        terms = out["loss_objective"], out["loss_entropy"]
        gradients = torch.autograd.grad(sum(x.sum() for x in terms), [*actor.parameters()])
        results.append([*(x.squeeze().detach() for x in terms), out["ESS"].detach(), *gradients])
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)


def test_torchrl_s_divergence_without_padding():
    actor, data = language_model()
    data[COMPLETION].fill_(True)  # theirs averages over padding, so let there be none
    data["advantage"] = torch.zeros(16, 13, 1)
    results = []
    for kind in (losses.GRPOLoss, TorchRLGRPOLoss):
        out = TensorDict(kind(actor, kl_to_ref_coeff=0.3, entropy_bonus=False)(data.clone()).to_dict())
        results.append(
            [out["loss_kl_to_ref"].detach(), *torch.autograd.grad(out["loss_kl_to_ref"], [*actor.parameters()])]
        )
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)


def test_keys_can_be_renamed():
    actor, data = language_model()
    loss = losses.GRPOLoss(actor)
    before = loss(data)["loss_objective"]
    loss.set_keys(advantage="mine", sample_log_prob=("old", "log_prob"))
    assert {"mine", ("old", "log_prob")} <= set(loss.in_keys) and "advantage" not in loss.in_keys
    data["mine"], data["old", "log_prob"] = data.pop("advantage"), data.pop(LOG_PROBS)
    torch.testing.assert_close(loss(data)["loss_objective"], before)


def test_ppo_with_a_value_head():
    actor, data = language_model()
    env = envs.prompts("addition", 4)
    critic = modules.token_value(env, width=32)
    data["value_target"] = torch.randn(16, 13, 1)
    loss = losses.GRPOLoss(actor, critic, critic_coeff=0.5)
    out = loss(data)
    mask = data[COMPLETION]
    error = (critic(data.clone())["state_value"] - data["value_target"]).squeeze(-1)[mask]
    torch.testing.assert_close(out["loss_critic"], 0.5 * error.square().mean())
    assert set(out.keys()) == set(loss.out_keys) and out["explained_variance"] < 1
    out["loss_critic"].backward()
    assert all(p.grad is None or not p.grad.any() for p in actor.parameters())


def test_supervised_cross_entropy_by_hand():
    actor = Table(3, 4, 3)
    data = batch(actor, RATIOS, ADVANTAGES)
    log_p = actor.logits.log_softmax(-1)
    expected = -sum(log_p[i, t - 1, data[TOKENS][i, t]] for i, t in ((0, 1), (1, 1), (1, 2))) / 3
    out = losses.SFTLoss(actor)(data)
    torch.testing.assert_close(out["loss_sft"], expected, rtol=1e-12, atol=0)
    assert set(out.keys()) == set(losses.SFTLoss(actor).out_keys)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ratio": "word"}, "ratio='word': give token, sequence"),
        ({"aggregation": "mean"}, "aggregation='mean': give token, sequence, constant"),
        ({"kl": "k4"}, "kl='k4': give k1, k2, k3"),
        ({"clip_epsilon": -0.1}, "clip_epsilon_low=-0.1: give a number that is at least 0"),
    ],
)
def test_unknown_settings(settings, message):
    with pytest.raises(UserError, match=message):
        losses.GRPOLoss(Table(2, 3, 3), **settings)


def test_an_advantage_of_another_shape_is_refused():
    actor = Table(3, 4, 3)
    data = batch(actor, RATIOS, ADVANTAGES)
    data["advantage"] = data["advantage"][:, :1]
    with pytest.raises(ValueError, match=r"advantage has shape \(3, 1, 1\) but log_ratio has shape \(3, 4, 1\)"):
        losses.GRPOLoss(actor)(data)
