"""Weights on a sphere: what is put back after each step of the optimizer."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from pgkit.modules.ensemble import EnsembleBatchRenorm, EnsembleLinear, EnsembleRMSNorm

Layer = nn.Linear | EnsembleLinear | EnsembleBatchRenorm | EnsembleRMSNorm


class WeightProjection:
    r"""``project(parameters)`` brings weights of networks back to unit length, in place.

    Weights before a normalization have a direction that counts and a length that does not: it only grows, and the
    learning rate's effect falls with it. SimbaV2 (Lee et al., 2025, https://arxiv.org/abs/2502.15280) and FlashSAC
    (https://arxiv.org/abs/2604.04539) keep the length. Give it to :class:`pgkit.updates.OffPolicyUpdate`
    (``project=``), which calls it in the compiled step.

    - Linear layers: for each output :math:`w \leftarrow w / |w|`; biases stay.
    - Batch norms: :math:`(w, b) \leftarrow \sqrt d \, (w, b) / |(w, b)|`, RMS norms the same without :math:`b`.

    Args:
        networks: their layers are projected now and, where they were trained, at every call. Of other layers than those
            of :mod:`pgkit.modules` and ``nn.Linear`` nothing is changed.
    """

    def __init__(self, *networks: nn.Module) -> None:
        self.layers = [part for network in networks for part in network.modules() if isinstance(part, Layer)]
        self([p for network in networks for p in network.parameters()])

    @torch.no_grad()
    def __call__(self, parameters: Iterable[Tensor]) -> None:
        """Projects the layers whose weight is among ``parameters``: those that a step has trained."""
        trained = {id(p) for p in parameters}
        for layer in self.layers:
            if id(layer.weight) in trained:
                _project(layer)


def _project(layer: Layer) -> None:
    if isinstance(layer, nn.Linear):
        _scale([layer.weight], 1.0)
    elif isinstance(layer, EnsembleLinear):
        _scale([layer.weight.mT], 1.0)
    else:
        parts = [layer.weight, layer.bias] if isinstance(layer, EnsembleBatchRenorm) else [layer.weight]
        _scale(parts, layer.weight.shape[-1] ** 0.5)


def _scale(parts: list[Tensor], length: float) -> None:
    """Gives vectors along the last dimension, of all parts together, this length."""
    squares = torch.stack([part.square().sum(-1, keepdim=True) for part in parts]).sum(0)
    for part in parts:
        part.mul_(length * (squares + 1e-16).rsqrt())
