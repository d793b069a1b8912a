"""Weights on a sphere: what is put back after each step of the optimizer."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pgkit.modules.ensemble import EnsembleBatchRenorm, EnsembleLinear, EnsembleRMSNorm


class WeightProjection:
    r"""``project()`` brings the weights of networks back to unit length, in place.

    Weights before a normalization have a direction that counts and a length that does not: it only grows, and the
    learning rate's effect falls with it. SimbaV2 (Lee et al., 2025, https://arxiv.org/abs/2502.15280) and FlashSAC
    (https://arxiv.org/abs/2604.04539) keep the length. Give it to :class:`pgkit.updates.OffPolicyUpdate`
    (``project=``), which calls it in the compiled step.

    - Linear layers: for each output :math:`w \leftarrow w / |w|`; biases stay.
    - Batch norms: :math:`(w, b) \leftarrow \sqrt d \, (w, b) / |(w, b)|`, RMS norms the same without :math:`b`.

    Args:
        networks: their layers are projected now and at every call. Of other layers than those of :mod:`pgkit.modules`
            and ``nn.Linear`` nothing is changed.
    """

    def __init__(self, *networks: nn.Module) -> None:
        self.layers = [layer for network in networks for layer in network.modules()]
        self()

    @torch.no_grad()
    def __call__(self) -> None:
        """Projects."""
        for layer in self.layers:
            if isinstance(layer, nn.Linear):
                _scale([layer.weight], 1.0)
            elif isinstance(layer, EnsembleLinear):
                _scale([layer.weight.mT], 1.0)
            elif isinstance(layer, EnsembleBatchRenorm):
                _scale([layer.weight, layer.bias], layer.weight.shape[-1] ** 0.5)
            elif isinstance(layer, EnsembleRMSNorm):
                _scale([layer.weight], layer.weight.shape[-1] ** 0.5)


def _scale(parts: list[Tensor], length: float) -> None:
    """Gives vectors along the last dimension, of all parts together, this length."""
    squares = torch.stack([part.square().sum(-1, keepdim=True) for part in parts]).sum(0)
    for part in parts:
        part.mul_(length * (squares + 1e-16).rsqrt())
