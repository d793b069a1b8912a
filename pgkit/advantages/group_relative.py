"""GRPO's advantage over a rollout: no critic, an attempt against the others of its group."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pgkit.advantages.base import Advantage, ends
from pgkit.errors import UserError, within
from pgkit.functional import batch_relative, group_relative, has_spread, kl_estimate, lambda_return, leave_one_out

LOG_PROBS, REFERENCE = ("log_probs", "full"), ("next", "ref_log_probs", "full")
COMPLETION = ("masks", "all_assistant_mask")


class GroupRelative(Advantage):
    """An attempt's outcome against those of its group, at all of its steps.

    Shao et al., 2024 (https://arxiv.org/abs/2402.03300). ``group_size`` neighbouring rows are attempts at one task.

    - Token rows ``[B]``: the outcome is ``("next", "reward") [B, 1]``; the advantage is ``[B, L, 1]``, 0 outside the
      completion.
    - A rollout ``[N, T]``: the outcome is the return of each row's first episode; later steps have advantage 0.

    The value target is the outcome, or the reward to go, for a loss that wants one.

    Args:
        group_size: attempts at one task, at least 2; divides the rows.
        kind: ``group``: less the group's mean, over its deviation; ``mean``: without the deviation, Dr. GRPO's
            (https://arxiv.org/abs/2503.20783); ``leave_one_out``: less the mean of the others, RLOO's
            (https://arxiv.org/abs/2402.14740); ``batch``: less the group's mean, over the batch's deviation.
        drop: token rows: groups whose rewards are all equal leave the batch (DAPO, https://arxiv.org/abs/2503.14476).
        multiple: with ``drop``, the rows left are a multiple of this, such as a minibatch, at least one: rows that left
            fill up, with a mask of False and log-probabilities of 0. ``group_size`` by default.
        kl_coeff: token rows: subtract so much of the summed divergence from the reference off the reward.
        kl: its estimate, as in :func:`~pgkit.functional.kl_estimate`.
        divide: False is another name of ``kind="mean"``.
        gamma: discount of a rollout's rewards.
        standardize, return_scale: of a rollout, as in :class:`~pgkit.advantages.Advantage`.

    Raises:
        UserError: a group of one; the reward is not one number a row.
    """

    recordable = False

    def __init__(
        self,
        group_size: int,
        *,
        kind: str = "group",
        drop: bool = False,
        multiple: int | None = None,
        kl_coeff: float = 0.0,
        kl: str = "k1",
        divide: bool = True,
        gamma: float = 1.0,
        standardize: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__(None, gamma=gamma, standardize=standardize, return_scale=return_scale)
        within(0, float("inf"), kl_coeff=kl_coeff)
        if group_size < 2:
            raise UserError(f"group_size={group_size}: an attempt is measured against others, give at least 2")
        if kind not in KINDS:
            raise UserError(f"kind={kind!r}: give {', '.join(KINDS)}")
        self.group_size, self.kind, self.drop = group_size, kind if divide or kind != "group" else "mean", drop
        self.multiple, self.kl_coeff, self.kl = multiple or group_size, kl_coeff, kl

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        reward, done, terminated = ends(rollout)
        target = lambda_return(next_value, reward, done, terminated, self.gamma, 1.0)
        advantage = KINDS[self.kind](target[:, 0, 0], self.group_size)
        first = torch.cat([torch.zeros_like(done[:, :1]), done[:, :-1]], 1).cumsum(1) == 0
        return advantage.view(-1, 1, 1) * first, target

    @torch.no_grad()
    def forward(self, rollout: TensorDictBase) -> TensorDictBase:
        """Reads and returns ``rollout``: token rows ``[B]``, or steps ``[N, T]``."""
        if rollout.batch_dims > 1:
            return super().forward(rollout)
        reward, mask, log_prob = rollout["next", "reward"], rollout[COMPLETION], rollout[LOG_PROBS]
        if reward.shape != (len(rollout), 1):
            raise UserError(
                f"the reward of {len(rollout)} completions has shape {tuple(reward.shape)}: give one number each, "
                f"({len(rollout)}, 1)"
            )
        score = reward.squeeze(-1)
        if self.kl_coeff:
            divergence = kl_estimate(rollout[REFERENCE] - log_prob, self.kl)
            score = score - self.kl_coeff * torch.where(mask, divergence, 0.0).sum(1)
        advantage = KINDS[self.kind](score, self.group_size).unsqueeze(-1)
        rollout.set("advantage", (advantage * mask).unsqueeze(-1))
        rollout.set("value_target", (reward * mask).unsqueeze(-1))
        return self._with_spread(rollout) if self.drop else rollout

    def _with_spread(self, rollout: TensorDictBase) -> TensorDictBase:
        """The rows of groups with spread, filled up to a multiple with rows whose mask is False."""
        live = has_spread(rollout["next", "reward"].squeeze(-1), self.group_size)
        mask = rollout[COMPLETION] & live.unsqueeze(-1)
        rollout.set(COMPLETION, mask).set(LOG_PROBS, torch.where(mask, rollout[LOG_PROBS], 0.0))
        count = max(1, -(-int(live.sum()) // self.multiple)) * self.multiple
        return cast(TensorDictBase, rollout[live.int().argsort(descending=True, stable=True)[:count]])


KINDS = {
    "group": group_relative,
    "mean": lambda score, group_size: group_relative(score, group_size, divide=False),
    "leave_one_out": leave_one_out,
    "batch": batch_relative,
}
