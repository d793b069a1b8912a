"""Layers of several networks side by side, ``[num, B, features]``: one batched operation for all of them.

Every parameter and buffer begins with the dimension ``num``, so that some members can be taken out by an index.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class EnsembleLinear(nn.Module):
    """``num`` linear layers as one ``bmm``: ``[num, B, in] -> [num, B, out]``; orthogonal weights, zero biases.

    The bias is added apart, where a compiler adds it in the activation's kernel: ``baddbmm`` copies it out first.
    """

    bias: nn.Parameter | None

    def __init__(self, num: int, in_features: int, out_features: int, gain: float, bias: bool = True) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(num, in_features, out_features))
        self.bias = nn.Parameter(torch.zeros(num, 1, out_features)) if bias else None
        for member in self.weight.data:
            nn.init.orthogonal_(member, gain)

    def forward(self, x: Tensor) -> Tensor:
        out = torch.bmm(x, self.weight)
        return out if self.bias is None else out + self.bias


class EnsembleLayerNorm(nn.Module):
    """``num`` layer norms (Ba et al., 2016, https://arxiv.org/abs/1607.06450): ``[num, B, features]`` to the same."""

    def __init__(self, num: int, features: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num, 1, features))
        self.bias = nn.Parameter(torch.zeros(num, 1, features))

    def forward(self, x: Tensor) -> Tensor:
        return torch.addcmul(self.bias, F.layer_norm(x, x.shape[-1:]), self.weight)


class EnsembleRMSNorm(nn.Module):
    r"""``num`` RMS norms (Zhang & Sennrich, 2019, https://arxiv.org/abs/1910.07467): ``[num, B, features]`` to same.

    .. math:: y = w x \Big/ \sqrt{\textstyle\frac1d \sum_i x_i^2 + \epsilon}
    """

    def __init__(self, num: int, features: int, eps: float = 1e-6) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num, 1, features))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        return x * (x.square().mean(-1, keepdim=True) + self.eps).rsqrt() * self.weight


class EnsembleDropout(nn.Dropout):
    """Dropout (Srivastava et al., 2014): zeros with probability ``p``, the rest divided by ``1 - p``.

    Each member, row and unit of ``[num, B, features]`` has a zero of its own. Random numbers are drawn for each row
    and each unit only, and mixed by a hash (MurmurHash3's): ``nn.Dropout`` draws for each element, which doubles the
    cost of an update.
    """

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return x
        num, rows, features = x.shape

        def draw(*shape: int) -> Tensor:
            return torch.randint(-(2**31), 2**31 - 1, shape, dtype=torch.int32, device=x.device)

        mixed = draw(num, rows, 1) ^ draw(num, 1, features)
        mixed = (mixed ^ (mixed >> 16 & 0xFFFF)) * -0x7A143595
        mixed = (mixed ^ (mixed >> 13 & 0x7FFFF)) * -0x3D4D51CB
        return x * (mixed >= int(self.p * 2**32) - 2**31) / (1 - self.p)


class EnsembleBatchRenorm(nn.Module):
    r"""``num`` batch renormalizations (Ioffe, 2017, https://arxiv.org/abs/1702.03275), ``[num, B, features]`` to same.

    .. math::
        y = w \Big(\frac{x - \mu_B}{\sigma_B} r + d\Big) + b, \qquad
        r = \text{clip}\Big(\frac{\sigma_B}{\sigma}, \frac1{r_{max}}, r_{max}\Big), \quad
        d = \text{clip}\Big(\frac{\mu_B - \mu}{\sigma}, \pm d_{max}\Big)

    :math:`\mu, \sigma` are running statistics, kept as buffers. The first ``warmup`` steps are plain batch
    normalization (:math:`r = 1, d = 0`). The batch's statistics are used, and the running ones updated, only where
    gradients reach this layer's own weights: never in evaluation, under ``no_grad``, or through detached parameters, as
    in a target or in an actor's loss. There :math:`y = w (x - \mu) / \sigma + b`.

    Args:
        num: members.
        features: size of the last dimension.
        momentum: share of the batch's statistics that the running ones take over.
        eps: added to variances.
        r_max, d_max: bounds of the correction.
        warmup: steps before it begins; ``inf`` is plain batch normalization for good.
    """

    mean: Tensor
    var: Tensor
    steps: Tensor

    def __init__(
        self,
        num: int,
        features: int,
        *,
        momentum: float = 0.01,
        eps: float = 1e-3,
        r_max: float = 3.0,
        d_max: float = 5.0,
        warmup: float = 100_000,
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num, 1, features))
        self.bias = nn.Parameter(torch.zeros(num, 1, features))
        self.register_buffer("mean", torch.zeros(num, 1, features))
        self.register_buffer("var", torch.ones(num, 1, features))
        self.register_buffer("steps", torch.zeros(num, 1, 1))
        self.momentum, self.eps, self.r_max, self.d_max, self.warmup = momentum, eps, r_max, d_max, warmup

    def forward(self, x: Tensor) -> Tensor:
        running = (self.var + self.eps).sqrt()
        if not (self.training and torch.is_grad_enabled() and _is_trained(self.weight)):
            return (x - self.mean) / running * self.weight + self.bias
        var, mean = torch.var_mean(x, 1, correction=0, keepdim=True)
        std = (var + self.eps).sqrt()
        with torch.no_grad():
            late = (self.steps >= self.warmup).to(x.dtype)
            r = 1 + late * ((std / running).clamp(1 / self.r_max, self.r_max) - 1)
            d = late * ((mean - self.mean) / running).clamp(-self.d_max, self.d_max)
            self.mean.add_(self.momentum * (mean - self.mean))
            self.var.add_(self.momentum * (var - self.var))
            self.steps.add_(1)
        return ((x - mean) / std * r + d) * self.weight + self.bias


def _is_trained(weight: Tensor) -> bool:
    """Whether gradients reach ``weight``, through ``vmap`` too, where it hides it (a list of critics)."""
    while torch._C._functorch.is_batchedtensor(weight):
        weight = torch._C._functorch.get_unwrapped(weight)
    return weight.requires_grad
