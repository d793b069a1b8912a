"""Hugging Face's causal language models as actors (extra ``llm``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pgkit.errors import UserError
from pgkit.modules.tokens import TokenActor, Vocabulary


def hugging_face(model: str | Path | nn.Module, env: Vocabulary, *, temperature: float = 1.0) -> TokenActor:
    """A causal language model of transformers as the actor of a prompt environment, in float32, without dropout.

    Args:
        model: a folder that ``save_pretrained`` wrote, a ``.gguf`` file, or the model itself.
        env: of :func:`pgkit.envs.prompts`, with the model's tokenizer (:func:`hugging_face_tokenizer`).
        temperature: divides the logits, in sampling and in scoring alike.

    Raises:
        UserError: transformers is not installed, or there is no model there.
    """
    loaded = (
        model
        if isinstance(model, nn.Module)
        else _load(lambda library: library.AutoModelForCausalLM, Path(model), dtype=torch.float32)
    )
    network = HuggingFaceNetwork(loaded)
    if env.vocab_size > network.vocab_size:
        raise UserError(
            f"the prompts have a vocabulary of {env.vocab_size} tokens, the model knows {network.vocab_size}: "
            "envs.prompts(..., tokenizer=modules.hugging_face_tokenizer(model))"
        )
    return TokenActor(network, env, temperature=temperature)


def hugging_face_tokenizer(model: str | Path | Any) -> HuggingFaceTokenizer:
    """The tokenizer of a folder or ``.gguf`` file, or one of transformers, for ``envs.prompts(tokenizer=)``."""
    return HuggingFaceTokenizer(
        _load(lambda library: library.AutoTokenizer, Path(model)) if isinstance(model, str | Path) else model
    )


def _load(kind: Callable[[Any], Any], path: Path, **settings: Any) -> Any:
    try:
        import transformers
    except ImportError:
        raise UserError('models of Hugging Face need transformers: pip install "pgkit-rl[llm]"') from None
    if not path.exists():
        raise UserError(f"{path}: no such folder or .gguf file (models are read from the disk, never downloaded)")
    folder, file = (path.parent, {"gguf_file": path.name}) if path.suffix == ".gguf" else (path, {})
    try:
        return kind(transformers).from_pretrained(folder, local_files_only=True, **file, **settings)
    except (OSError, ValueError, ImportError) as error:
        raise UserError(f"{path} holds no model that transformers reads: {str(error).splitlines()[0]}") from error


class HuggingFaceTokenizer:
    """What a prompt environment asks of a tokenizer, from one of transformers; completions end with its eos."""

    def __init__(self, tokenizer: Any) -> None:
        self.tokenizer = tokenizer
        if tokenizer.eos_token_id is None:
            raise UserError("the tokenizer has no eos token, which ends a completion: set tokenizer.eos_token")
        self.vocab_size, self.stop = len(tokenizer), int(tokenizer.eos_token_id)
        self.pad = self.stop if tokenizer.pad_token_id is None else int(tokenizer.pad_token_id)

    def encode(self, text: str) -> list[int]:
        return self.tokenizer.encode(text, add_special_tokens=False)

    def decode(self, tokens: Sequence[int]) -> str:
        return self.tokenizer.decode(tokens, skip_special_tokens=True)


class Cache:
    """transformers' cache of keys and values."""

    def __init__(self, entries: Any) -> None:
        self.entries = entries

    def repeat(self, copies: int) -> Cache:
        """Every row ``copies`` times, neighbours."""
        self.entries.batch_repeat_interleave(copies)
        return self


class HuggingFaceNetwork(nn.Module):
    """``(tokens [B, n], mask [B, length + n], cache) -> logits [B, n, V]``; positions count what is no padding."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model.eval()
        self.vocab_size = int(model.get_input_embeddings().weight.shape[0])
        self.context = int(model.config.max_position_embeddings)

    def train(self, mode: bool = True) -> HuggingFaceNetwork:
        """Stays in evaluation mode: dropout would make scores differ from those of the samples."""
        return super().train(False)

    def cache(self, rows: int, length: int) -> Cache:
        """An empty cache."""
        from transformers import DynamicCache

        return Cache(DynamicCache())

    def forward(self, tokens: Tensor, mask: Tensor, cache: Cache | None = None) -> Tensor:
        position = (mask.cumsum(1) - 1).clamp(min=0)[:, -tokens.shape[1] :]
        return self.model(
            input_ids=tokens,
            attention_mask=mask.long(),
            position_ids=position,
            cache=None if cache is None else cache.entries,
            use_cache=cache is not None,
        ).logits
