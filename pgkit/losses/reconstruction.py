"""The reconstruction of images from their features (SAC-AE: Yarats et al., 2021, https://arxiv.org/abs/1910.01741)."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from pgkit.errors import within
from pgkit.functional import quantized_pixels
from pgkit.losses.base import Loss


class ReconstructionLoss(Loss):
    r"""A further term beside SAC's: a decoder draws the observation from what the encoder made of it.

    .. math::
        h = f(s), \qquad L = \frac{1}{|s|} \lVert g(h) - \tilde s \rVert^2 + \frac{\lambda}{2} \lVert h \rVert^2

    with the mean over the batch and :math:`\tilde s` the pixels of five bits
    (:func:`pgkit.functional.quantized_pixels`). ``losses.Sum(SACLoss(actor, critics), ReconstructionLoss(encoder,
    modules.decoder(encoder)))`` trains the critics' encoder by both.

    Args:
        encoder: images ``[*B, channels, height, width]`` to features; the critics'.
        decoder: features ``[B, features]`` to images in [-0.5, 0.5).
        latent_coeff: :math:`\lambda`.
        key: entry of the images, uint8.

    Writes ``loss_reconstruction``.
    """

    encoder_network: TensorDictModule
    encoder_network_params: Any
    decoder_network: TensorDictModule
    decoder_network_params: Any
    target_encoder_network_params: Any
    target_decoder_network_params: Any
    latent_coeff: Tensor

    def __init__(
        self,
        encoder: nn.Module,
        decoder: nn.Module,
        *,
        latent_coeff: float = 1e-6,
        key: NestedKey = "observation",
        reduction: str | None = None,
    ) -> None:
        super().__init__(reduction)
        within(0, 1, latent_coeff=latent_coeff)
        self.key = key
        self.convert_to_functional(TensorDictModule(encoder, [key], ["features"]), "encoder_network")
        self.convert_to_functional(TensorDictModule(decoder, ["features"], ["decoded"]), "decoder_network")
        self.register_coeff_buffer("latent_coeff", latent_coeff, dtype=torch.float64)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss of a batch ``[*B]``, which is not changed."""
        images = tensordict.get(self.key).flatten(0, tensordict.dim() - 1)
        rows = TensorDict({self.key: images}, [len(images)])
        with self.encoder_network_params.to_module(self.encoder_network, preserve_module_state=False):
            rows = self.encoder_network(rows)
        with self.decoder_network_params.to_module(self.decoder_network, preserve_module_state=False):
            decoded = self.decoder_network(rows)["decoded"]
        error = (decoded - quantized_pixels(images).reshape(decoded.shape)).square().flatten(1).mean(1)
        size = rows["features"].square().sum(-1) / 2
        loss = self.reduce(error + self.latent_coeff * size, rows)
        return TensorDict({"loss_reconstruction": loss})

    def _reads(self) -> list[NestedKey]:
        return [self.key]

    def _writes(self) -> list[NestedKey]:
        return ["loss_reconstruction"]
