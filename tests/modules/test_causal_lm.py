"""The small language model: what it samples it scores alike, padding changes nothing, the cache repeats the model."""

import pytest
import torch
from tensordict import TensorDict

from pgkit import envs, modules
from pgkit.errors import UserError
from pgkit.modules.tokens import TokenDistribution, draw


def model(seed=0, scale=1.5, **settings):
    """A model whose logits are not all alike, and an environment."""
    torch.manual_seed(seed)
    env = envs.prompts("addition", 6, seed=seed)
    actor = modules.causal_lm(env, width=32, **settings)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(scale)
    return env, actor


def rows(completions):
    tokens, attention, completion, _ = completions
    masks = {"all_attention_mask": attention, "all_assistant_mask": completion}
    return TensorDict({"tokens": {"full": tokens}, "masks": masks}, [len(tokens)])


@pytest.mark.parametrize("temperature", [1.0, 0.7])
@pytest.mark.parametrize("top_p", [1.0, 0.6])
def test_sampling_and_scoring_agree(temperature, top_p):
    env, actor = model(temperature=temperature)
    sampled = actor.sample(env.reset()["observation"], env.completion_length, 4, top_p=top_p)
    scored = actor(rows(sampled))["log_probs", "full"]
    torch.testing.assert_close(sampled.log_prob, scored, rtol=0, atol=1e-5)
    assert sampled.log_prob[sampled.completion].lt(0).any() and sampled.log_prob[~sampled.completion].eq(0).all()


def test_rows_end_with_their_stop_token():
    env, actor = model()
    observation = env.reset()["observation"]
    tokens, attention, completion, _ = actor.sample(observation, 5, 40)
    assert tokens.shape == (240, env.prompt_length + 5)
    prompt = observation.repeat_interleave(40, 0)
    assert torch.equal(attention[:, :8], prompt >= 0) and not completion[:, :8].any()
    assert torch.equal(tokens[:, :8], prompt.clamp(min=env.pad))
    stopped = (tokens[:, 8:] == env.stop).any(1)
    assert 0 < stopped.sum() < 240
    first = (tokens[:, 8:] == env.stop).int().argmax(1)
    assert torch.equal(completion.sum(1), torch.where(stopped, first + 1, 5))
    assert tokens[:, 8:][~completion[:, 8:]].eq(env.pad).all()


def test_padding_on_either_side_changes_no_score():
    env, actor = model()
    data = rows(actor.sample(env.reset()["observation"], 5, 3))
    other = data.clone()
    left = ~other["masks", "all_attention_mask"]
    other["tokens", "full"][left] = 7  # what stands in the padding is not read
    torch.testing.assert_close(actor(other)["log_probs", "full"], actor(data)["log_probs", "full"])
    short = TensorDict(
        {  # the same rows without two columns of padding on the left
            "tokens": {"full": data["tokens", "full"][:, 2:]},
            "masks": {k: data["masks", k][:, 2:] for k in data["masks"].keys()},
        },
        data.batch_size,
    )
    fits = ~data["masks", "all_attention_mask"][:, :2].any(1)
    assert fits.any()
    torch.testing.assert_close(
        actor(short[fits])["log_probs", "full"], actor(data[fits])["log_probs", "full"][:, 2:], rtol=0, atol=1e-5
    )


def test_the_future_is_not_seen():
    env, actor = model()
    data = rows(actor.sample(env.reset()["observation"], 5, 3))
    before = actor(data.clone())["log_probs", "full"]
    data["tokens", "full"][:, -1] = 5
    torch.testing.assert_close(actor(data)["log_probs", "full"][:, :-1], before[:, :-1])


def test_greedy_takes_the_likeliest_and_top_p_leaves_out_the_rest():
    env, actor = model()
    observation = env.reset()["observation"]
    greedy = actor.sample(observation, 5, greedy=True)
    dist = actor.get_dist(rows(greedy))
    likeliest = dist.logits.argmax(-1)
    kept = greedy.completion[:, 1:]
    assert torch.equal(greedy.tokens[:, 1:][kept], likeliest[kept])
    log_prob = torch.tensor([[0.5, 0.3, 0.15, 0.05]]).log().expand(4000, 4)
    torch.manual_seed(0)
    counts = draw(log_prob, 0.7).bincount(minlength=4) / 4000  # .5 + .3 reach .7: 5/8 and 3/8 of the draws
    torch.testing.assert_close(counts, torch.tensor([0.625, 0.375, 0, 0]), rtol=0, atol=0.03)
    torch.testing.assert_close(draw(log_prob).bincount(minlength=4) / 4000, log_prob[0].exp(), rtol=0, atol=0.03)


def test_a_distribution_by_hand():
    # the first token is given, the second has odds 1 : 3, the third is masked
    logits = torch.tensor([[[0.0, 0.0], [5.0, 0.0]]])
    logits[0, 0, 1] = torch.tensor(3.0).log()
    dist = TokenDistribution(logits, torch.tensor([[False, True, False]]))
    torch.testing.assert_close(dist.log_prob(torch.tensor([[0, 1, 0]])), torch.tensor([[0.0, -0.2876821, 0.0]]))
    # -(1/4 log 1/4 + 3/4 log 3/4) = log 4 - 3/4 log 3
    torch.testing.assert_close(dist.entropy(), torch.tensor([[0.0, 0.5623351, 0.0]]))


def test_a_policy_completes_observations():
    env, actor = model()
    data = TensorDict(env.reset(), [6])
    greedy = modules.TokenPolicy(actor, 5, greedy=True)
    assert torch.equal(greedy(data.clone())["action"], actor.sample(data["observation"], 5, greedy=True).tokens[:, 8:])
    actor.temperature.fill_(1e-4)  # whatever the actor's own temperature, an evaluation draws at 1
    drawn = torch.stack([modules.TokenPolicy(actor, 5)(data.clone())["action"] for _ in range(4)])
    assert not torch.equal(drawn[0], drawn[1])


def test_values_of_prefixes():
    env, _ = model()
    critic = modules.token_value(env, width=32)
    actor = modules.causal_lm(env, width=32)
    data = rows(actor.sample(env.reset()["observation"], 5, 2))
    value = critic(data.clone())["state_value"]
    assert value.shape == (12, 13, 1) and value[:, 0].eq(0).all()
    data["tokens", "full"][:, -1] = 5  # the last token is no part of its own prefix
    torch.testing.assert_close(critic(data)["state_value"], value)


def test_what_does_not_fit():
    env, actor = model()
    with pytest.raises(UserError, match="width=30 over heads=4: give a width that is a multiple of 8"):
        modules.causal_lm(env, width=30)
    with pytest.raises(UserError, match="14 tokens in a row, the model has a context of 13: make prompts shorter"):
        actor.sample(env.reset()["observation"], 7, 2)
