"""Generalized advantage estimation over the tokens of a completion, for PPO on token rows."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from pgkit.errors import within
from pgkit.functional import generalized_advantage, standardize

COMPLETION = ("masks", "all_assistant_mask")


class TokenGAE(TensorDictModuleBase):
    """Writes ``advantage`` and ``value_target`` ``[B, L, 1]`` of token rows ``[B]``, 0 outside the completion.

    A completion's reward comes with its last token, after which nothing follows (also where it hit the limit): the
    recursion is that of :func:`~pgkit.functional.generalized_advantage`, its steps are tokens. The advantage is
    standardized over the completions' tokens.

    Args:
        critic: reads the rows, writes ``state_value [B, L, 1]``: the value of the prefix before each token.
        gamma: discount a token.
        lmbda: lambda.
    """

    recordable = False

    def __init__(self, critic: TensorDictModule, *, gamma: float = 1.0, lmbda: float = 0.95) -> None:
        super().__init__()
        within(0, 1, gamma=gamma, lmbda=lmbda)
        self.critic, self.gamma, self.lmbda = critic, gamma, lmbda
        self.standardizer = standardize  # of several learners, one over the rows of all
        self.in_keys = [*critic.in_keys, COMPLETION, ("next", "reward")]
        self.out_keys = ["advantage", "value_target", "state_value"]

    @torch.no_grad()
    def forward(self, rollout: TensorDictBase) -> TensorDictBase:
        """Reads and returns ``rollout``."""
        mask = rollout[COMPLETION].unsqueeze(-1)
        value = self.critic(rollout.select(*self.critic.in_keys))["state_value"]
        last = mask & ~torch.cat([mask[:, 1:], torch.zeros_like(mask[:, :1])], 1)
        reward = rollout["next", "reward"].unsqueeze(-1) * last
        following = torch.cat([value[:, 1:], torch.zeros_like(value[:, :1])], 1)
        advantage, target = generalized_advantage(value, following, reward, last, last, self.gamma, self.lmbda)
        rollout.set("advantage", self.standardizer(advantage, mask) * mask)
        rollout.set("value_target", target * mask)
        return rollout.set("state_value", value)
