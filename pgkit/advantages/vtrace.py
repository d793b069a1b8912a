"""V-trace over a rollout that another policy may have collected."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution, TensorDictModule, set_composite_lp_aggregate
from tensordict.utils import NestedKey
from torch import Tensor

from pgkit.advantages.base import Advantage, ends
from pgkit.functional import listed, same_shape, vtrace


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
        log_prob_key: the present policy's log-probability, ``[*B, T]``.
        sample_log_prob: the collecting policy's; by default what the actor writes, ``action_log_prob`` without one.
            Of a composite action a list: its parts are added up.
    """

    lmbda: Tensor

    def __init__(
        self,
        critic: TensorDictModule,
        actor: TensorDictModule | None,
        *,
        gamma: float = 0.99,
        lmbda: float = 1.0,
        rho_thresh: float = 1.0,
        c_thresh: float = 1.0,
        log_prob_key: NestedKey = "current_log_prob",
        sample_log_prob: NestedKey | list[NestedKey] | None = None,
        standardize: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__(critic, gamma=gamma, standardize=standardize, return_scale=return_scale)
        self.register_buffer("lmbda", torch.tensor(float(lmbda)))
        self.actor, self.rho_thresh, self.c_thresh = actor, rho_thresh, c_thresh
        if sample_log_prob is None:
            sample_log_prob = "action_log_prob" if actor is None else list(actor.log_prob_keys)
        self.log_prob_key, self.sample_log_prob = log_prob_key, sample_log_prob
        reads = [log_prob_key] if actor is None else [*actor.in_keys, *actor.dist_sample_keys]
        self.in_keys = list(dict.fromkeys([*self.in_keys, *listed(sample_log_prob), *reads]))
        self.out_keys += [] if actor is None else [log_prob_key]

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        if self.actor is not None:
            dist = self.actor.get_dist(rollout.select(*self.actor.in_keys))
            composite = isinstance(dist, CompositeDistribution)
            with set_composite_lp_aggregate(True):
                actions = rollout if composite else rollout[self.actor.dist_sample_keys[0]]
                rollout.set(self.log_prob_key, dist.log_prob(actions))
        log_prob = rollout[self.log_prob_key]
        old_log_prob = torch.stack([rollout[key] for key in listed(self.sample_log_prob)]).sum(0)
        same_shape(log_prob=log_prob, old_log_prob=old_log_prob)
        return vtrace(
            (log_prob - old_log_prob).unsqueeze(-1), value, next_value, *ends(rollout),
            self.gamma, self.lmbda, self.rho_thresh, self.c_thresh,
        )  # fmt: skip
