"""GRPO and its variants on token rows (Shao et al., 2024, https://arxiv.org/abs/2402.03300)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from pgkit.errors import UserError, within
from pgkit.functional import (
    approx_kl,
    clip_surrogate,
    explained_variance,
    kl_estimate,
    same_shape,
    sequence_log_ratio,
    token_weights,
)
from pgkit.losses.base import Loss

AGGREGATIONS = {name: name for name in ("token", "sequence", "constant")} | {  # and TorchRL's names
    "token_mean": "token",
    "prompt_mean": "sequence",
}


class GRPOLoss(Loss):
    r"""GRPO on rows of tokens, in the layout and with the keys of TorchRL's loss of that name.

    .. math::
        L = -\sum_{i,t} w_{i,t} \min\big(r_{i,t} A_{i,t}, \text{clip}(r_{i,t}, 1-\epsilon_{low}, 1+\epsilon_{high})
            A_{i,t}\big) + \beta \sum_{i,t} w_{i,t}\, KL_{i,t} - c_H \sum_{i,t} w_{i,t} H_{i,t}

    Sums are over the completions' tokens; everything else counts nowhere. The weights :math:`w` are those of
    :func:`~pgkit.functional.token_weights`. Differs from TorchRL's: the entropy coefficient is 0 (there 0.01), and
    metrics and the KL leave padding out.

    Args:
        actor_network: a language model with ``get_dist``, as of :func:`pgkit.modules.causal_lm`.
        critic_network: writes ``state_value [B, L, 1]``: PPO on tokens; None: no value loss.
        clip_epsilon: :math:`\epsilon`, or the pair :math:`(\epsilon_{low}, \epsilon_{high})` (DAPO's is 0.2, 0.28);
            buffers ``clip_epsilon_low`` and ``clip_epsilon_high``.
        surrogate: replaces the clipped surrogate, as in :class:`~pgkit.losses.ClipPPOLoss`:
            ``(log_ratio, advantage) -> objective``, all ``[B, L, 1]``.
        ratio: of each ``token``, or of the whole ``sequence`` (GSPO, https://arxiv.org/abs/2507.18071).
        aggregation: ``token``, ``sequence`` or ``constant``; TorchRL's ``token_mean`` and ``prompt_mean`` are the first
            two.
        max_length: the :math:`L` of ``constant``; the rows' length by default.
        kl_to_ref_coeff: :math:`\beta`, of the divergence from ``("next", "ref_log_probs", "full")``; 0: not read.
        kl: its estimate, ``k1``, ``k2`` or ``k3``.
        entropy_coeff: :math:`c_H`.
        entropy_bonus: whether to compute the entropy at all.
        critic_coeff: weight of the squared error of the value.

    Writes ``loss_objective``, ``loss_kl_to_ref``, ``loss_entropy``, ``loss_critic`` and the metrics ``kl_approx``,
    ``clip_fraction``, ``ESS``, ``kl_to_ref``, ``entropy``, ``explained_variance``.

    Raises:
        UserError: an unknown ``ratio``, ``aggregation`` or ``kl``.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change, with TorchRL's names and defaults."""

        advantage: NestedKey = "advantage"
        action: NestedKey = ("tokens", "full")
        sample_log_prob: NestedKey = ("log_probs", "full")
        ref_log_probs: NestedKey = ("next", "ref_log_probs", "full")
        mask: NestedKey = ("masks", "all_assistant_mask")
        value: NestedKey = "state_value"
        value_target: NestedKey = "value_target"

    default_keys = _AcceptedKeys
    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset(
        {"clip_epsilon_low", "clip_epsilon_high", "kl_to_ref_coeff", "entropy_coeff", "critic_coeff"}
    )

    clip_epsilon_low: Tensor
    clip_epsilon_high: Tensor
    kl_to_ref_coeff: Tensor
    entropy_coeff: Tensor
    critic_coeff: Tensor
    critic_network: TensorDictModule | None
    critic_network_params: Any
    target_critic_network_params: Any

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule | None = None,
        *,
        clip_epsilon: float | tuple[float, float] = 0.2,
        surrogate: Callable[[Tensor, Tensor], Tensor] | None = None,
        ratio: str = "token",
        aggregation: str = "token",
        max_length: int | None = None,
        kl_to_ref_coeff: float | None = None,
        kl: str = "k3",
        entropy_coeff: float = 0.0,
        entropy_bonus: bool = True,
        critic_coeff: float = 1.0,
    ) -> None:
        low, high = clip_epsilon if isinstance(clip_epsilon, tuple | list) else (clip_epsilon, clip_epsilon)
        coefficients = {
            "clip_epsilon_low": low,
            "clip_epsilon_high": high,
            "kl_to_ref_coeff": kl_to_ref_coeff or 0.0,
            "entropy_coeff": entropy_coeff,
            "critic_coeff": critic_coeff,
        }
        within(0, float("inf"), **coefficients)
        one_of(("token", "sequence"), ratio=ratio)
        one_of(AGGREGATIONS, aggregation=aggregation)
        one_of(("k1", "k2", "k3"), kl=kl)
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")
        if critic_network is None:
            self.critic_network = None
        else:
            self.convert_to_functional(critic_network, "critic_network")
        for name, value in coefficients.items():
            self.register_coeff_buffer(name, value, dtype=torch.float64)
        self.surrogate, self.ratio, self.kl = surrogate, ratio, kl
        self.aggregation, self.max_length = AGGREGATIONS[aggregation], max_length
        self.entropy_bonus, self.has_reference = entropy_bonus, bool(kl_to_ref_coeff)

    def _reads(self) -> list[NestedKey]:
        keys = self.tensor_keys
        read = [*self.actor_network.in_keys, keys.action, keys.mask, keys.sample_log_prob, keys.advantage]
        read += [keys.ref_log_probs] * self.has_reference
        return read if self.critic_network is None else [*read, *self.critic_network.in_keys, keys.value_target]

    def _writes(self) -> list[NestedKey]:
        written: list[NestedKey] = ["loss_objective", "kl_approx", "clip_fraction", "ESS"]
        written += ["loss_kl_to_ref", "kl_to_ref"] * self.has_reference
        written += ["loss_entropy", "entropy"] * self.entropy_bonus
        return written + ["loss_critic", "explained_variance"] * (self.critic_network is not None)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses and metrics of rows ``[B]`` with ``advantage`` ``[B, L, 1]``."""
        keys, batch = self.tensor_keys, tensordict.copy()
        mask, advantage, old_log_prob = batch[keys.mask], batch[keys.advantage], batch[keys.sample_log_prob]
        with self.actor_network_params.to_module(self.actor_network):
            dist = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))
        log_prob = dist.log_prob(batch[keys.action])
        same_shape(log_prob=log_prob, old_log_prob=old_log_prob, mask=mask)
        token_log_ratio = torch.where(mask, log_prob - old_log_prob, 0.0)
        log_ratio = token_log_ratio if self.ratio == "token" else sequence_log_ratio(token_log_ratio, mask)
        log_ratio = log_ratio.unsqueeze(-1)
        if self.surrogate is None:
            objective = clip_surrogate(log_ratio, advantage, self.clip_epsilon_low, self.clip_epsilon_high)
        else:
            objective = self.surrogate(log_ratio, advantage)
        same_shape(advantage=advantage, surrogate=objective)

        weights = token_weights(mask, self.aggregation, self.max_length, log_prob.dtype)
        out = TensorDict({"loss_objective": -total(weights, objective.squeeze(-1), mask)})
        self._add_terms(out, batch, weights, mask, log_prob, dist)
        self._add_metrics(out, mask, token_log_ratio.detach(), log_ratio.detach().squeeze(-1))
        return out

    def _add_terms(
        self, out: TensorDict, batch: TensorDictBase, weights: Tensor, mask: Tensor, log_prob: Tensor, dist: Any
    ) -> None:
        """The terms besides the objective, each with its metric."""
        keys, each = self.tensor_keys, token_weights(mask, dtype=log_prob.dtype)
        if self.has_reference:
            divergence = kl_estimate(torch.where(mask, batch[keys.ref_log_probs] - log_prob, 0.0), self.kl)
            out["loss_kl_to_ref"] = total(weights, self.kl_to_ref_coeff * divergence, mask)
            out["kl_to_ref"] = total(each, divergence.detach(), mask)
        if self.entropy_bonus:
            entropy = dist.entropy()
            out["loss_entropy"] = -total(weights, self.entropy_coeff * entropy, mask)
            out["entropy"] = total(each, entropy.detach(), mask)
        if self.critic_network is not None:
            with self.critic_network_params.to_module(self.critic_network):
                value = self.critic_network(batch.select(*self.critic_network.in_keys))[keys.value]
            target = batch[keys.value_target]
            same_shape(value=value, value_target=target)
            out["loss_critic"] = total(each, self.critic_coeff * (value - target).square().squeeze(-1), mask)
            out["explained_variance"] = explained_variance(value.detach(), target, mask.unsqueeze(-1))

    def _add_metrics(self, out: TensorDict, mask: Tensor, token_log_ratio: Tensor, log_ratio: Tensor) -> None:
        """How far the policy is from the one that sampled; ``ESS`` as a share of the tokens."""
        each, ratio = token_weights(mask, dtype=log_ratio.dtype), log_ratio.exp()
        clipped = (ratio < 1 - self.clip_epsilon_low) | (ratio > 1 + self.clip_epsilon_high)
        out["kl_approx"] = total(each, approx_kl(token_log_ratio), mask)
        out["clip_fraction"] = total(each, clipped.to(each.dtype), mask)
        out["ESS"] = total(each, ratio, mask).square() / total(each, ratio.square(), mask).clamp(min=1e-12)


def total(weights: Tensor, x: Tensor, mask: Tensor) -> Tensor:
    """The weighted sum of ``x`` over the mask, ``[B, L]`` each; what is outside may be NaN."""
    return (weights * torch.where(mask, x, 0.0)).sum()


def one_of(known: Any, **setting: str) -> None:
    """Raises ``UserError`` for a name that is not among those known."""
    for name, value in setting.items():
        if value not in known:
            raise UserError(f"{name}={value!r}: give {', '.join(known)}")
