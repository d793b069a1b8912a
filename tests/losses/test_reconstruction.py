"""The reconstruction term by hand."""

import torch
from tensordict import TensorDict
from torch import nn

from pgkit import losses


class Constant(nn.Module):
    """A bias ``[size]`` for every row."""

    def __init__(self, *shape, value):
        super().__init__()
        self.bias = nn.Parameter(torch.full(shape, value, dtype=torch.float64))

    def forward(self, x):
        return self.bias.expand(len(x), *self.bias.shape)


def test_the_squared_error_of_five_bits_and_the_size_of_the_features_by_hand():
    # pixels of 80 are 10 of 32 levels, noise u within [0, 1): the target is (10 + u) / 32 - 0.5, for 4 pixels
    # features (2, 2): |h|^2 / 2 = 4, times 0.25 is 1; the decoder says -0.1
    encoder, decoder = Constant(2, value=2.0), Constant(1, 2, 2, value=-0.1)
    loss = losses.ReconstructionLoss(encoder, decoder, latent_coeff=0.25)
    batch = TensorDict({"observation": torch.full((3, 1, 2, 2), 80, dtype=torch.uint8)}, [3])
    torch.manual_seed(0)
    out = loss(batch)
    torch.manual_seed(0)
    target = (10 + torch.rand(3, 1, 2, 2)) / 32 - 0.5
    expected = (-0.1 - target.double()).square().mean() + 1.0
    torch.testing.assert_close(out["loss_reconstruction"], expected)
    assert set(batch.keys()) == {"observation"}
    by_features, by_pixels = torch.autograd.grad(out["loss_reconstruction"], [encoder.bias, decoder.bias])
    torch.testing.assert_close(by_features, torch.full((2,), 0.5, dtype=torch.float64))  # lambda * h
    torch.testing.assert_close(by_pixels, 2 * (-0.1 - target.double()).mean(0) / 4)
    assert loss.in_keys == ["observation"] and loss.out_keys == ["loss_reconstruction"]
