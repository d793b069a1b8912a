"""Supervised learning of completions, the warm start of a language model."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey

from pgkit.functional import token_weights
from pgkit.losses.base import Loss


class SFTLoss(Loss):
    r"""Cross-entropy of the completions' tokens.

    .. math::
        L = -\frac{1}{\sum_j |y_j|} \sum_{i,t} \log \pi(y_{i,t})

    Args:
        actor_network: a language model with ``get_dist``, as of :func:`pgkit.modules.causal_lm`.

    Writes ``loss_sft`` and the metric ``entropy``.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change."""

        action: NestedKey = ("tokens", "full")
        mask: NestedKey = ("masks", "all_assistant_mask")

    default_keys = _AcceptedKeys

    def __init__(self, actor_network: TensorDictModule) -> None:
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")

    def _reads(self) -> list[NestedKey]:
        return [*self.actor_network.in_keys, self.tensor_keys.action, self.tensor_keys.mask]

    def _writes(self) -> list[NestedKey]:
        return ["loss_sft", "entropy"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss of rows ``[B]``."""
        batch = tensordict.copy()
        with self.actor_network_params.to_module(self.actor_network):
            dist = self.actor_network.get_dist(batch.select(*self.actor_network.in_keys))
        log_prob = dist.log_prob(batch[self.tensor_keys.action])
        weights = token_weights(batch[self.tensor_keys.mask], dtype=log_prob.dtype)
        loss = -(weights * log_prob).sum()
        return TensorDict({"loss_sft": loss, "entropy": (weights * dist.entropy().detach()).sum()})
