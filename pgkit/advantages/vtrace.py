"""V-trace over a rollout that another policy may have collected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution, TensorDictModule, set_composite_lp_aggregate
from tensordict.utils import NestedKey
from torch import Tensor

from pgkit.advantages.base import Advantage, Keys, as_values
from pgkit.errors import within
from pgkit.functional import listed, same_shape, vtrace
from pgkit.functional.modes import in_evaluation


class VTrace(Advantage):
    """Advantages and value targets of the present policy from a rollout of an older one.

    Espeholt et al., 2018 (https://arxiv.org/abs/1802.01561). The advantage carries the clipped importance weight:
    :class:`~pgkit.losses.A2CLoss` on it is IMPALA. The rollout's own actions are scored (TorchRL's ``VTrace`` scores
    actions drawn anew). Besides what every estimator writes, the present policy's
    log-probability of each action goes to ``log_prob_key``: a PPO loss that reads it as its ``sample_log_prob`` clips
    around the present policy (Hilton et al., 2022, https://arxiv.org/abs/2110.00641).

    Arguments as in :class:`~pgkit.advantages.Advantage`, and

    Args:
        actor: the present policy; None: its log-probabilities are in the rollout, at ``log_prob_key``.
        lmbda: weight of the long traces; the paper's is 1.
        rho_thresh: bound of the importance weight of a step.
        c_thresh: bound of the weight that carries a later step's error back.
        log_prob_key: the present policy's log-probability, ``[*B, T]``; by default ``current_log_prob``, under the
            critic's group if there is one.
        sample_log_prob: the collecting policy's; by default what the actor writes, ``action_log_prob`` without one.
            Of a composite action a list: its parts are added up.
    """

    @dataclass(frozen=True)
    class _AcceptedKeys(Advantage._AcceptedKeys):
        """Those of every estimator, and the two log-probabilities."""

        log_prob: NestedKey = "current_log_prob"
        sample_log_prob: Keys = "action_log_prob"

    lmbda: Tensor
    tensor_keys: _AcceptedKeys

    def __init__(
        self,
        critic: TensorDictModule,
        actor: TensorDictModule | None,
        *,
        gamma: float = 0.99,
        lmbda: float = 1.0,
        rho_thresh: float = 1.0,
        c_thresh: float = 1.0,
        log_prob_key: NestedKey | None = None,
        sample_log_prob: Keys | None = None,
        standardize: bool = False,
        per_agent: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__(critic, gamma=gamma, standardize=standardize, per_agent=per_agent, return_scale=return_scale)
        within(0, 1, lmbda=lmbda)
        self.register_buffer("lmbda", torch.tensor(float(lmbda), dtype=torch.float64))
        self.actor, self.rho_thresh, self.c_thresh = actor, rho_thresh, c_thresh
        if sample_log_prob is None:
            sample_log_prob = self.under_group("action_log_prob") if actor is None else list(actor.log_prob_keys)
        self.set_keys(log_prob=log_prob_key or self.under_group("current_log_prob"), sample_log_prob=sample_log_prob)

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        if self.actor is not None:
            with in_evaluation(self.actor):
                dist = self.actor.get_dist(rollout.select(*self.actor.in_keys))
            composite = isinstance(dist, CompositeDistribution)
            with set_composite_lp_aggregate(True):
                actions = rollout if composite else rollout[self.actor.dist_sample_keys[0]]
                rollout.set(self.tensor_keys.log_prob, dist.log_prob(actions))
        log_prob = rollout[self.tensor_keys.log_prob]
        old_log_prob = torch.stack([rollout[key] for key in listed(self.tensor_keys.sample_log_prob)]).sum(0)
        same_shape(log_prob=log_prob, old_log_prob=old_log_prob)
        log_ratio = as_values((log_prob - old_log_prob).unsqueeze(-1), value, rollout)
        return vtrace(
            log_ratio, value, next_value, *self.ends(value, rollout),
            self.gamma, self.lmbda, self.rho_thresh, self.c_thresh,
        )  # fmt: skip

    def _reads(self) -> list[NestedKey]:
        keys, actor = self.tensor_keys, self.actor
        acted = [keys.log_prob] if actor is None else [*actor.in_keys, *actor.dist_sample_keys]
        return [*super()._reads(), *listed(keys.sample_log_prob), *acted]

    def _writes(self) -> list[NestedKey]:
        return [*super()._writes(), *([] if self.actor is None else [self.tensor_keys.log_prob])]
