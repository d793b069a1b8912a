"""Distributions of returns: quantile regression, and categories on a fixed support."""

from __future__ import annotations

from math import sqrt

import torch
from torch import Tensor

from pgkit.functional.checks import same_shape


def quantile_huber(quantiles: Tensor, atoms: Tensor, weights: Tensor, kappa: float = 1.0) -> Tensor:
    r"""Quantile regression with a Huber distance, towards a target distribution of weighted atoms.

    .. math::
        \frac1N \sum_{i=1}^N \sum_k w_k\, |\tau_i - 1\{z_k < \theta_i\}|\, \frac{H_\kappa(z_k - \theta_i)}{\kappa},
        \qquad \tau_i = \frac{2i - 1}{2N}

    Dabney et al., 2018 (https://arxiv.org/abs/1710.10044, eq. 10).

    Args:
        quantiles: :math:`\theta`, ``[*B, N]``.
        atoms: :math:`z`, ``[*B, K]``.
        weights: :math:`w`, ``[*B, K]``, sums to 1 over ``K``.
        kappa: where :math:`H_\kappa` turns from a square into a straight line.

    Returns:
        ``[*B]``.
    """
    same_shape(atoms=atoms, weights=weights)
    same_shape(batch_of_quantiles=quantiles[..., 0], batch_of_atoms=atoms[..., 0])
    count = quantiles.shape[-1]
    tau = (torch.arange(count, dtype=quantiles.dtype, device=quantiles.device) + 0.5) / count
    delta = atoms.unsqueeze(-2) - quantiles.unsqueeze(-1)  # [*B, N, K]
    size = delta.abs()
    huber = torch.where(size <= kappa, 0.5 * delta.square() / kappa, size - 0.5 * kappa)
    slope = (tau.unsqueeze(-1) - (delta.detach() < 0).to(tau.dtype)).abs()
    return (slope * huber * weights.unsqueeze(-2)).sum(-1).mean(-1)


def two_hot(value: Tensor, support: Tensor) -> Tensor:
    r"""A number as the two bins next to it, weighted so that their mean is the number again.

    .. math:: p_j = \Big(1 - \frac{|x - z_j|}{\Delta}\Big)_+, \qquad x = \text{clip}(value, z_1, z_n)

    Args:
        value: ``[*B]``.
        support: :math:`z`, ``[bins]``, equally spaced by :math:`\Delta`.

    Returns:
        Probabilities ``[*B, bins]``.
    """
    width = support[1] - support[0]
    x = value.clamp(support[0], support[-1]).unsqueeze(-1)
    return (1 - (x - support).abs() / width).clamp_min(0)


def hl_gauss(value: Tensor, support: Tensor, ratio: float = 0.75) -> Tensor:
    r"""A number as a histogram of a Gaussian around it, :math:`\sigma = ratio \cdot \Delta`.

    .. math::
        p_j \propto \Phi\Big(\frac{z_j + \Delta/2 - x}{\sigma}\Big) - \Phi\Big(\frac{z_j - \Delta/2 - x}{\sigma}\Big)

    Farebrother et al., 2024 (https://arxiv.org/abs/2403.03950, eq. 6); ``value`` is clipped to the support first.

    Args:
        value: ``[*B]``.
        support: :math:`z`, the bins' centers ``[bins]``, equally spaced by :math:`\Delta`.
        ratio: deviation in widths of a bin.

    Returns:
        Probabilities ``[*B, bins]``.
    """
    width = support[1] - support[0]
    edges = torch.cat([support - width / 2, (support[-1] + width / 2).unsqueeze(0)])
    x = value.clamp(support[0], support[-1]).unsqueeze(-1)
    mass = torch.erf((edges - x) / (sqrt(2) * ratio * width))
    return mass.diff(dim=-1) / (mass[..., -1:] - mass[..., :1])


def categorical_projection(atoms: Tensor, weights: Tensor, support: Tensor) -> Tensor:
    r"""A distribution of weighted atoms on a fixed support, :math:`\sum_k w_k\, \text{two-hot}(z_k)`.

    Bellemare et al., 2017 (https://arxiv.org/abs/1707.06887, eq. 7).

    Args:
        atoms: ``[*B, K]``.
        weights: ``[*B, K]``, sums to 1 over ``K``.
        support: ``[bins]``, equally spaced.

    Returns:
        Probabilities ``[*B, bins]``.
    """
    same_shape(atoms=atoms, weights=weights)
    return (two_hot(atoms, support) * weights.unsqueeze(-1)).sum(-2)


def cross_entropy(logits: Tensor, probabilities: Tensor) -> Tensor:
    r""":math:`-\sum_j p_j \log \text{softmax}(l)_j`, ``[*B, bins] -> [*B]``."""
    same_shape(logits=logits, probabilities=probabilities)
    return -(probabilities * logits.log_softmax(-1)).sum(-1)


def categorical_mean(logits: Tensor, support: Tensor) -> Tensor:
    r"""Mean :math:`\sum_j \text{softmax}(l)_j z_j` of logits ``[*B, bins]`` over a support ``[bins]``: ``[*B]``."""
    return (logits.softmax(-1) * support).sum(-1)
