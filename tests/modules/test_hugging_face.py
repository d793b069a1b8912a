"""A tiny random model of transformers, saved locally: it samples and scores alike, and trains."""

import pytest
import torch
import transformers
from tensordict import TensorDict

from pgkit import advantages, collectors, envs, losses, modules, updates
from pgkit.errors import UserError
from tests.recipes.test_ppo import pgkit, rows


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A llama of two layers, with a character tokenizer."""
    from tokenizers import Regex, Tokenizer, decoders, models, pre_tokenizers

    path = tmp_path_factory.mktemp("model")
    vocab = {c: i for i, c in enumerate(["<end>", "<unk>", *"0123456789+="])}
    tokenizer = Tokenizer(models.WordLevel(vocab, unk_token="<unk>"))
    tokenizer.decoder = decoders.Fuse()
    tokenizer.pre_tokenizer = pre_tokenizers.Split(Regex("."), "isolated")
    transformers.PreTrainedTokenizerFast(tokenizer_object=tokenizer, eos_token="<end>").save_pretrained(path)
    torch.manual_seed(0)
    config = transformers.LlamaConfig(
        vocab_size=14, hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=4,
        max_position_embeddings=32, initializer_range=0.4, bos_token_id=None, eos_token_id=0, attention_dropout=0.5,
    )  # fmt: skip
    transformers.LlamaForCausalLM(config).save_pretrained(path)
    return path


def agent(folder, **settings):
    env = envs.prompts("addition", 3, seed=1, tokenizer=modules.hugging_face_tokenizer(folder))
    return env, modules.hugging_face(folder, env, **settings)


def test_sampling_and_scoring_agree_though_its_padding_is_its_stop_token(folder):
    env, actor = agent(folder, temperature=0.8)
    assert env.pad == env.stop == 0
    rows = actor.train().sample(env.reset()["observation"], env.completion_length, 20)
    masks = {"all_attention_mask": rows.attention, "all_assistant_mask": rows.completion}
    scored = actor(TensorDict({"tokens": {"full": rows.tokens}, "masks": masks}, [60]))["log_probs", "full"]
    torch.testing.assert_close(scored.detach(), rows.log_prob, rtol=0, atol=1e-5)
    stopped = (rows.tokens[:, 8:] == env.stop) & rows.completion[:, 8:]
    assert stopped.any() and stopped.sum(1).max() == 1 and (env.observation_spec["observation"].shape == (3, 8))
    assert env.verify(env.texts, env.completions([env.task.solution(text) for text in env.texts]))["correct"].all()


def test_an_update_trains_it(folder):
    env, actor = agent(folder)
    before = [p.clone() for p in actor.parameters()]
    env.rewards = {"short": lambda prompt, completion: -len(completion)}
    update = updates.OnPolicyUpdate(
        losses.GRPOLoss(actor), advantages.GroupRelative(4), torch.optim.Adam(actor.parameters(), lr=1e-3),
        epochs=1, minibatch_size=12, compile="off",
    )  # fmt: skip
    metrics = update(collectors.TokenCollector(env, actor, group_size=4).rollout())
    assert abs(metrics["kl_approx"]) < 1e-6 and metrics["grad_norm"] > 0
    assert all(not torch.equal(a, b) for a, b in zip(before, actor.parameters(), strict=True))


def test_what_does_not_fit(folder, tmp_path):
    with pytest.raises(UserError, match="no such folder or .gguf file"):
        modules.hugging_face_tokenizer(tmp_path / "nothing")
    with pytest.raises(UserError, match="holds no model that transformers reads"):
        modules.hugging_face(tmp_path, envs.prompts("addition"))
    with pytest.raises(UserError, match="a vocabulary of 97 tokens, the model knows 14: envs.prompts"):
        modules.hugging_face(
            folder, envs.prompts("countdown", tokenizer=envs.Characters("".join(map(chr, range(33, 128)))))
        )


def test_the_recipe_begins_with_a_folder(folder, tmp_path):
    flags = ["--prompts", 4, "--group-size", 2, "--total-frames", 8, "--eval-episodes", 500, "--compile", "off"]
    out = pgkit("run", "grpo", "--init", folder, *flags, "--run-dir", tmp_path / "run")
    assert "warm start" not in out.stdout and len(rows(tmp_path / "run")) == 1
    assert (tmp_path / "run" / "checkpoints" / "latest.pt").exists()
