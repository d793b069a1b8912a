"""Token rows: groups, masks, rewards by name, figures; what does not fit is said in one line."""

import pytest
import torch
from tensordict import TensorDict

from pgkit import collectors, envs, modules
from pgkit.errors import UserError
from pgkit.modules.tokens import Completions


class Scripted(torch.nn.Module):
    """Answers every prompt with the same texts, one a copy."""

    def __init__(self, env, answers):
        super().__init__()
        self.network, self.env, self.answers = env, env, answers

    def sample(self, observation, length, copies, top_p=1.0):
        completion = self.env.completions(self.answers).repeat(len(observation), 1)
        prompt = observation.repeat_interleave(copies, 0)
        kept = completion != self.env.pad
        flags = [torch.cat([part, kept], 1) for part in (prompt >= 0, torch.zeros_like(prompt, dtype=torch.bool))]
        tokens = torch.cat([prompt.clamp(min=0), completion], 1)
        return Completions(tokens, *flags, torch.where(flags[1], -0.5, 0.0))


def test_a_rollout_by_hand():
    rewards = {"length": lambda p, c: len(c), "a": lambda p, c: 0.5 * (c == "a")}
    env = envs.prompts(["xy"], 2, reward=rewards, prompt_length=3, completion_length=3)
    collector = collectors.TokenCollector(env, Scripted(env, ["a", "bc", "bcd"]), group_size=3)
    rollout = collector.rollout()
    assert rollout.batch_size == (6,) and rollout["tokens", "full"].shape == (6, 6)
    assert rollout["next", "reward"].flatten().tolist() == [1.5, 2, 3] * 2
    assert rollout["next", "rewards", "a"].flatten().tolist() == [0.5, 0, 0] * 2
    assert rollout["next", "step_count"].flatten().tolist() == [2, 3, 3] * 2  # with the stop token
    assert rollout["next", "truncated"].flatten().tolist() == [False, False, True] * 2
    assert rollout["next", "terminated"].flatten().tolist() == [True, True, False] * 2
    metrics = collector.metrics
    assert metrics.pop("time/tokens_per_s") > 0
    assert metrics == pytest.approx(
        {
            "rollout/reward": 6.5 / 3, "rollout/reward_length": 2.0, "rollout/reward_a": 0.5 / 3,
            "rollout/length": 8 / 3, "rollout/hit_limit": 1 / 3, "rollout/no_spread": 0.0,
        }
    )  # fmt: skip
    assert collector.frames == 6


def agent(**settings):
    torch.manual_seed(0)
    env = envs.prompts("addition", 4, seed=2)
    actor = modules.causal_lm(env, width=32)
    return env, actor, collectors.TokenCollector(env, actor, **settings)


def test_it_stops_and_goes_on_where_it_was():
    _, _, collector = agent(group_size=2, total_frames=20)
    rollouts = list(collector)
    assert len(rollouts) == 3 and collector.frames == 24
    state = collector.state_dict()
    torch.manual_seed(5)
    expected = collector.rollout()
    _, _, other = agent(group_size=2)
    other.load_state_dict(state)
    torch.manual_seed(5)
    got = other.rollout()
    assert other.frames == 32 and all(torch.equal(got[key], expected[key]) for key in got.keys(True, True))
    groups = expected["tokens", "full"][:, :8].view(4, 2, 8)
    assert torch.equal(groups[:, 0], groups[:, 1]) and not torch.equal(groups[0], groups[1])


def test_a_temperature_is_sampled_and_scored_with():
    _, actor, collector = agent(group_size=2, temperature=0.5)
    rollout = collector.rollout()
    assert actor.temperature == 0.5
    torch.testing.assert_close(
        actor(rollout.copy())["log_probs", "full"], rollout["log_probs", "full"], rtol=0, atol=1e-5
    )
    actor.temperature.fill_(1.0)
    assert not torch.allclose(actor(rollout.copy())["log_probs", "full"], rollout["log_probs", "full"], atol=1e-3)


def test_a_reference_scores_the_rows():
    env, actor, _ = agent()
    torch.manual_seed(9)
    reference = modules.causal_lm(env, width=32)
    rollout = collectors.TokenCollector(env, actor, group_size=2, reference=reference).rollout()
    written = rollout["next", "ref_log_probs", "full"]
    entries = rollout.select("tokens", "masks")
    torch.testing.assert_close(written, reference(TensorDict(entries.to_dict(), [8]))["log_probs", "full"])
    assert not torch.allclose(written, rollout["log_probs", "full"], atol=1e-3)


def test_what_does_not_fit():
    env, actor, _ = agent()
    longer = envs.prompts("addition", 4, prompt_length=20)
    with pytest.raises(
        UserError, match="prompts of 20 and completions of 5 .* rows of 25, .* a context of 13: make them"
    ):
        collectors.TokenCollector(longer, actor)
    other = envs.prompts("addition", 4, tokenizer=envs.Characters("0123456789+=abc"))
    with pytest.raises(UserError, match="a vocabulary of 17 tokens, the model knows 14: build both with one tokenizer"):
        collectors.TokenCollector(other, actor)
    with pytest.raises(UserError, match="group_size=1: a completion is measured against others, give at least 2"):
        collectors.TokenCollector(env, actor, group_size=1)
    with pytest.raises(UserError, match="temperature=0: give a number above 0"):
        collectors.TokenCollector(env, actor, temperature=0)
    with pytest.raises(UserError, match="top_p=0: give a number above 0, at most 1"):
        collectors.TokenCollector(env, actor, top_p=0)
