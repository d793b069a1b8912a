"""A language model as an actor: it scores rows of tokens and samples completions of prompts."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.nn import functional as F

TOKENS, LOG_PROBS = ("tokens", "full"), ("log_probs", "full")
ATTENTION, COMPLETION = ("masks", "all_attention_mask"), ("masks", "all_assistant_mask")


class Vocabulary(Protocol):
    """What a language model must know of its prompts: sizes, and two tokens."""

    vocab_size: int
    context: int
    stop: int
    pad: int


class Completions(NamedTuple):
    """Rows of prompt and completion, each ``[B, L]``; the masks are as in TorchRL's layout.

    Attributes:
        tokens: the prompt, padded on the left, and the completion, padded on the right.
        attention: True at what is no padding.
        completion: True at the completion's tokens, the stop token included.
        log_prob: of the completion's tokens; 0 elsewhere.
    """

    tokens: Tensor
    attention: Tensor
    completion: Tensor
    log_prob: Tensor


class TokenDistribution(Distribution):
    """Of each token of a row given those before it; without a probability (log 1) where ``mask`` is False.

    Args:
        logits: ``[B, L - 1, V]``, of the second to the last token.
        mask: ``[B, L]``, the tokens that count; the first never does.
    """

    has_rsample = False

    def __init__(self, logits: Tensor, mask: Tensor) -> None:
        self.logits, self.mask = logits.log_softmax(-1), mask
        super().__init__(batch_shape=mask.shape, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        picked = self.logits.gather(-1, value[:, 1:].unsqueeze(-1)).squeeze(-1)
        return F.pad(torch.where(self.mask[:, 1:], picked, 0.0), (1, 0))

    def entropy(self) -> Tensor:
        entropy = -(self.logits.exp() * self.logits).sum(-1)
        return F.pad(torch.where(self.mask[:, 1:], entropy, 0.0), (1, 0))

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return F.pad(torch.distributions.Categorical(logits=self.logits).sample(sample_shape), (1, 0))


class TokenActor(TensorDictModuleBase):
    """A language model as a policy: writes ``("log_probs", "full")`` of a batch's rows, and samples completions.

    Args:
        network: ``(tokens [B, n], mask [B, length + n], cache) -> logits [B, n, V]``, with ``cache(rows, length)``.
        vocabulary: the stop and the padding token.
        temperature: divides the logits; a buffer, one for sampling and scoring.
    """

    temperature: Tensor
    dist_sample_keys = [TOKENS]
    log_prob_keys = [LOG_PROBS]

    def __init__(self, network: nn.Module, vocabulary: Vocabulary, *, temperature: float = 1.0) -> None:
        super().__init__()
        self.network, self.stop, self.pad = network, vocabulary.stop, vocabulary.pad
        self.register_buffer("temperature", torch.tensor(float(temperature), dtype=torch.float64))
        self.in_keys, self.out_keys = [TOKENS, ATTENTION, COMPLETION], [LOG_PROBS]

    def get_dist(self, tensordict: TensorDictBase, logits_key: str | None = None) -> TokenDistribution:
        """Distributions of a batch's tokens; ``logits_key``: TorchRL gives it, there is no use for it."""
        tokens, attention, completion = (tensordict[key] for key in self.in_keys)
        logits = self.network(tokens[:, :-1], attention[:, :-1]) / self.temperature
        return TokenDistribution(logits, completion)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(LOG_PROBS, self.get_dist(tensordict).log_prob(tensordict[TOKENS]))

    @torch.no_grad()
    def sample(
        self,
        observation: Tensor,
        length: int,
        copies: int = 1,
        *,
        top_p: float = 1.0,
        greedy: bool = False,
        temperature: float | None = None,
    ) -> Completions:
        """``copies`` completions of each prompt, of at most ``length`` tokens: rows ``[N * copies, P + length]``.

        Every prompt is read once, with a key-value cache. The log-probabilities are those of the whole policy at its
        temperature, whatever ``top_p`` leaves out, so that the loss's first ratio is 1.

        Args:
            observation: the prompts' tokens ``[N, P]``, -1 at the padding on their left.
            top_p: draw from the fewest tokens whose probabilities add up to this (Holtzman et al., 2019).
            greedy: the likeliest tokens.
            temperature: in place of the policy's own.
        """
        heat = self.temperature if temperature is None else temperature
        mask = observation >= 0
        prompt = torch.where(mask, observation, self.pad)
        start, total = prompt.shape[1], prompt.shape[1] + length
        cache: Any = self.network.cache(len(prompt), total)
        logits = self.network(prompt, mask, cache)[:, -1].repeat_interleave(copies, 0)
        cache = cache.repeat(copies)
        tokens = F.pad(prompt.repeat_interleave(copies, 0), (0, length), value=self.pad)
        attention = F.pad(mask.repeat_interleave(copies, 0), (0, length))
        log_prob = logits.new_zeros(tokens.shape)
        alive = torch.ones(len(tokens), dtype=torch.bool, device=tokens.device)
        for position in range(start, total):
            if position > start:
                logits = self.network(tokens[:, position - 1 : position], attention[:, :position], cache)[:, -1]
            log_p = (logits / heat).log_softmax(-1)
            token = log_p.argmax(-1) if greedy else draw(log_p, top_p)
            tokens[:, position] = torch.where(alive, token, self.pad)
            attention[:, position] = alive
            log_prob[:, position] = torch.where(alive, log_p.gather(-1, token.unsqueeze(-1)).squeeze(-1), 0.0)
            alive = alive & (token != self.stop)
            if not alive.any():
                break
        completion = attention.clone()
        completion[:, :start] = False
        return Completions(tokens, attention, completion, log_prob)


class TokenPolicy(TensorDictModuleBase):
    """An actor that plays a prompt environment: ``observation [N, P]`` to a completion ``action [N, length]``.

    It draws at temperature 1, also where an evaluation asks for the likeliest action: a share of solved prompts is that
    of the policy. ``greedy``: the likeliest tokens.
    """

    def __init__(self, actor: TokenActor, length: int, *, greedy: bool = False) -> None:
        super().__init__()
        self.actor, self.length, self.greedy = actor, length, greedy
        self.in_keys, self.out_keys = ["observation"], ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict["observation"].long()
        rows = self.actor.sample(observation, self.length, greedy=self.greedy, temperature=1.0)
        return tensordict.set("action", rows.tokens[:, observation.shape[1] :])


class TokenValue(TensorDictModuleBase):
    """Value of the prefix before each token, ``state_value [B, L, 1]``; the first token has none, 0."""

    def __init__(self, network: Any, width: int) -> None:
        super().__init__()
        self.network, self.head = network, nn.Linear(width, 1)
        self.in_keys, self.out_keys = [TOKENS, ATTENTION], ["state_value"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tokens, attention = (tensordict[key] for key in self.in_keys)
        value = self.head(self.network.features(tokens[:, :-1], attention[:, :-1]))
        return tensordict.set("state_value", F.pad(value, (0, 0, 1, 0)))


def draw(log_prob: Tensor, top_p: float = 1.0) -> Tensor:
    """One token a row of ``log_prob [B, V]``, by the largest of exponential races; ``top_p``: of the likeliest."""
    if top_p < 1:
        ordered, order = log_prob.sort(-1, descending=True)
        before = ordered.exp().cumsum(-1) - ordered.exp()  # of all likelier ones: the first always stays
        ordered = ordered.masked_fill(before >= top_p, -torch.inf)
        log_prob = torch.empty_like(log_prob).scatter_(-1, order, ordered)
    return (log_prob - torch.empty_like(log_prob).exponential_().log()).argmax(-1)
