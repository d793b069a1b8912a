"""Completions of prompts, in groups, as rows of tokens."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from pgkit.envs import Prompts
from pgkit.errors import UserError, check_whole_number


class TokenCollector:
    """An iterable of token rows ``[N * group_size]``: ``group_size`` completions of each of ``N`` prompts, neighbours.

    A row is in TorchRL's layout, each entry ``[B, L]``: ``("tokens", "full")`` with the prompt padded on the left and
    the completion on the right, ``("log_probs", "full")``, ``("masks", "all_attention_mask")`` and, True at the
    completion's tokens, ``("masks", "all_assistant_mask")``. Under ``next`` are ``reward`` and the flags ``[B, 1]``,
    each reward by its name under ``rewards``, and ``("ref_log_probs", "full")`` if there is a reference.

    Args:
        env: of :func:`pgkit.envs.prompts`.
        actor: of :func:`pgkit.modules.causal_lm` or :func:`pgkit.modules.hugging_face`.
        group_size: completions of a prompt.
        total_frames: completions in all; the last rollout may go beyond. None: without end.
        temperature: sets the actor's, which the loss scores with too; None: as it is.
        top_p: draw from the fewest tokens whose probabilities add up to this; the log-probabilities are those of the
            whole policy all the same.
        reference: the actor that a KL divergence is measured from.

    Attributes:
        frames: completions so far.
        metrics: of the last rollout, for a log: rewards, lengths, the share of completions that hit the limit, groups
            without spread, tokens a second.

    Raises:
        UserError: a group of one; the environment's vocabulary or context does not fit the model.
    """

    compile_seconds = 0.0

    def __init__(
        self,
        env: Prompts,
        actor: Any,
        *,
        group_size: int = 16,
        total_frames: int | None = None,
        temperature: float | None = None,
        top_p: float = 1.0,
        reference: Any = None,
    ) -> None:
        check_whole_number(1, total_frames=total_frames)
        if not 0 < top_p <= 1:
            raise UserError(f"top_p={top_p}: give a number above 0, at most 1")
        if group_size < 2:
            raise UserError(f"group_size={group_size}: a completion is measured against others, give at least 2")
        if env.vocab_size > actor.network.vocab_size:
            raise UserError(
                f"the prompts have a vocabulary of {env.vocab_size} tokens, the model knows "
                f"{actor.network.vocab_size}: build both with one tokenizer"
            )
        if env.context > actor.network.context:
            raise UserError(
                f"prompts of {env.prompt_length} and completions of {env.completion_length} tokens make rows of "
                f"{env.context}, the model has a context of {actor.network.context}: make them shorter"
            )
        if temperature is not None:
            if not 0 < temperature < float("inf"):
                raise UserError(f"temperature={temperature}: give a number above 0 (greedy tokens teach nothing)")
            actor.temperature.fill_(temperature)
        self.env, self.actor, self.reference = env, actor, reference
        self.group_size, self.total_frames, self.top_p = group_size, total_frames, top_p
        self.frames, self.metrics = 0, dict[str, float]()

    def __iter__(self) -> Iterator[TensorDict]:
        while self.total_frames is None or self.frames < self.total_frames:
            yield self.rollout()

    @torch.no_grad()
    def rollout(self) -> TensorDict:
        """Draws prompts, completes and verifies them."""
        observation = self.env.reset()["observation"]
        start = time.perf_counter()
        rows = self.actor.sample(observation, self.env.completion_length, self.group_size, top_p=self.top_p)
        seconds = time.perf_counter() - start
        completion = rows.tokens[:, self.env.prompt_length :]
        texts = [text for text in self.env.texts for _ in range(self.group_size)]
        rewards = self.env.verify(texts, completion)
        reward = torch.stack(list(rewards.values())).sum(0)
        cut = ~(completion == self.env.stop).any(1)
        length = rows.completion.sum(1)
        rollout = TensorDict(
            {
                "tokens": {"full": rows.tokens},
                "masks": {"all_attention_mask": rows.attention, "all_assistant_mask": rows.completion},
                "log_probs": {"full": rows.log_prob},
                "next": {
                    "reward": reward.unsqueeze(-1),
                    "done": torch.ones_like(cut).unsqueeze(-1),
                    "terminated": ~cut.unsqueeze(-1),
                    "truncated": cut.unsqueeze(-1),
                    "rewards": {name: each.unsqueeze(-1) for name, each in rewards.items()},
                    "episode_reward": reward.unsqueeze(-1),
                    "step_count": length.unsqueeze(-1),
                },
            },
            [len(reward)],
        )
        if self.reference is not None:
            rollout["next", "ref_log_probs", "full"] = self.reference(rollout.copy())["log_probs", "full"]
        self.frames += len(reward)
        self.metrics = self._figures(rewards, reward, length, cut, seconds)
        return rollout

    def _figures(
        self, rewards: dict[str, Tensor], reward: Tensor, length: Tensor, cut: Tensor, seconds: float
    ) -> dict[str, float]:
        groups = reward.view(-1, self.group_size)
        named = rewards if len(rewards) > 1 else {}
        return {
            "rollout/reward": float(reward.mean()),
            **{f"rollout/reward_{name}": float(each.mean()) for name, each in named.items()},
            "rollout/length": float(length.float().mean()),
            "rollout/hit_limit": float(cut.float().mean()),
            "rollout/no_spread": float((groups.amax(1) == groups.amin(1)).float().mean()),
            "time/tokens_per_s": int(length.sum()) / max(seconds, 1e-9),
        }

    def state_dict(self) -> dict[str, Any]:
        """The environment's state and the count of frames."""
        return {"env": self.env.state_dict(), "frames": self.frames}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self.env.load_state_dict(state["env"])
        self.frames = state["frames"]

    def shutdown(self) -> None:
        """Closes the environment."""
        self.env.close()
