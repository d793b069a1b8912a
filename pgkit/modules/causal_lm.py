"""A small decoder-only transformer: rotary positions, RMSNorm, the embedding tied to the output."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pgkit.errors import UserError, check_whole_number
from pgkit.modules.tokens import TokenActor, TokenValue, Vocabulary


def causal_lm(
    env: Vocabulary, layers: int = 2, width: int = 128, heads: int = 4, *, temperature: float = 1.0
) -> TokenActor:
    """A transformer as the actor of a prompt environment; about ``12 * layers * width ** 2`` parameters.

    Args:
        env: of :func:`pgkit.envs.prompts`: its vocabulary, context and stop token.
        layers, width, heads: blocks, features, attention heads; an even number of features a head.
        temperature: divides the logits, in sampling and in scoring alike.
    """
    check_whole_number(1, layers=layers, width=width, heads=heads)
    return TokenActor(Transformer(env.vocab_size, env.context, layers, width, heads), env, temperature=temperature)


def token_value(env: Vocabulary, layers: int = 2, width: int = 128, heads: int = 4) -> TokenValue:
    """A transformer's value ``state_value [B, L, 1]`` of each token's prefix, for PPO on tokens; args as above."""
    return TokenValue(Transformer(env.vocab_size, env.context, layers, width, heads), width)


class Cache:
    """Keys and values of the tokens read so far, for every layer; ``length`` counts them."""

    def __init__(self, keys: Tensor, values: Tensor) -> None:
        self.keys, self.values, self.length = keys, values, 0

    def repeat(self, copies: int) -> Cache:
        """Every row ``copies`` times, neighbours: a prompt is read once for its whole group."""
        cache = Cache(self.keys.repeat_interleave(copies, 1), self.values.repeat_interleave(copies, 1))
        cache.length = self.length
        return cache

    def extend(self, layer: int, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """Writes a layer's new entries ``[B, H, n, D]``; all of its entries so far, ``[B, H, length + n, D]``."""
        end = self.length + key.shape[2]
        self.keys[layer, :, :, self.length : end] = key
        self.values[layer, :, :, self.length : end] = value
        return self.keys[layer, :, :, :end], self.values[layer, :, :, :end]


class Transformer(nn.Module):
    """Reads ``tokens [B, n]`` after those in a cache, gives ``logits [B, n, V]`` of the tokens that come next.

    Positions are those in the row, padding on the left included: rotary attention knows distances alone.
    """

    cos: Tensor
    sin: Tensor

    def __init__(self, vocab_size: int, context: int, layers: int, width: int, heads: int) -> None:
        super().__init__()
        if width % (2 * heads):
            raise UserError(f"width={width} over heads={heads}: give a width that is a multiple of {2 * heads}")
        self.vocab_size, self.context, self.heads = vocab_size, context, heads
        self.embedding = nn.Embedding(vocab_size, width)
        nn.init.normal_(self.embedding.weight, std=0.1)
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(layers))
        for name, weight in self.blocks.named_parameters():
            if weight.dim() == 2:  # what is added to the sum begins smaller (Radford et al., 2019)
                added = name.endswith(("out.weight", "down.weight"))
                nn.init.normal_(weight, std=(weight.shape[1] * (2 * layers if added else 1)) ** -0.5)
        self.norm = nn.RMSNorm(width)
        size = width // heads
        base = max(100.0, 10.0 * context)  # the slowest rotation; slower ones would tell no two places here apart
        angle = torch.outer(torch.arange(context), base ** -(torch.arange(0, size, 2) / size))
        self.register_buffer("cos", angle.cos(), persistent=False)
        self.register_buffer("sin", angle.sin(), persistent=False)

    def cache(self, rows: int, length: int) -> Cache:
        """An empty cache for ``length`` tokens of ``rows`` rows."""
        weight, layers = self.embedding.weight, len(self.blocks)
        shape = (layers, rows, self.heads, length, weight.shape[1] // self.heads)
        return Cache(weight.new_empty(shape), weight.new_empty(shape))

    def features(self, tokens: Tensor, mask: Tensor, cache: Cache | None = None) -> Tensor:
        """What the last layer says of each token, ``[B, n, width]``; ``mask [B, length + n]``: no padding."""
        start = 0 if cache is None else cache.length
        end = start + tokens.shape[1]
        if end > self.context:
            raise UserError(f"{end} tokens in a row, the model has a context of {self.context}: make prompts shorter")
        query = torch.arange(start, end, device=tokens.device).unsqueeze(-1)
        key = torch.arange(end, device=tokens.device)
        # padding attends to itself: a row of a softmax over nothing would be NaN
        attend = ((key <= query) & mask[:, None, :] | (key == query)).unsqueeze(1)
        rotation = (self.cos[start:end], self.sin[start:end])
        x = self.embedding(tokens)
        for layer, block in enumerate(self.blocks):
            x = block(x, rotation, attend, layer, cache)
        if cache is not None:
            cache.length = end
        return self.norm(x)

    def forward(self, tokens: Tensor, mask: Tensor, cache: Cache | None = None) -> Tensor:
        return F.linear(self.features(tokens, mask, cache), self.embedding.weight)


class Block(nn.Module):
    """Attention and a perceptron, each on the normalized sum so far."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.perceptron_norm = nn.RMSNorm(width), nn.RMSNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width, bias=False), nn.Linear(width, width, bias=False)
        self.up, self.down = nn.Linear(width, 4 * width, bias=False), nn.Linear(4 * width, width, bias=False)

    def forward(self, x: Tensor, rotation: Any, attend: Tensor, layer: int, cache: Cache | None) -> Tensor:
        query, key, value = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in self.qkv(self.norm(x)).chunk(3, -1)
        )
        query, key = rotate(query, *rotation), rotate(key, *rotation)
        if cache is not None:
            key, value = cache.extend(layer, key, value)
        y = F.scaled_dot_product_attention(query, key, value, attend)
        x = x + self.out(y.transpose(1, 2).flatten(2))
        return x + self.down(F.gelu(self.up(self.perceptron_norm(x))))


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotary positions of ``x [..., n, D]`` (Su et al., 2021, https://arxiv.org/abs/2104.09864)."""
    a, b = x.chunk(2, -1)
    return torch.cat([a * cos - b * sin, b * cos + a * sin], -1)
