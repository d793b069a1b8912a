"""Token rows: how a ratio, an average and a divergence are taken over the tokens that a mask keeps."""

from __future__ import annotations

import torch
from torch import Tensor

from pgkit.functional.checks import is_flag, same_shape


def sequence_log_ratio(log_ratio: Tensor, mask: Tensor) -> Tensor:
    r"""GSPO's log-ratio of a whole row, at each of its tokens.

    Zheng et al., 2025 (https://arxiv.org/abs/2507.18071, eq. 7).

    .. math::
        \log s_i = \frac{1}{|y_i|} \sum_t \log \frac{\pi(y_{i,t})}{\pi_{old}(y_{i,t})}

    Args:
        log_ratio: of the tokens, ``[B, L]``.
        mask: the completion's tokens, bool ``[B, L]``.

    Returns:
        ``[B, L]``, one value a row.
    """
    same_shape(log_ratio=log_ratio, mask=mask)
    is_flag(mask=mask)
    kept = torch.where(mask, log_ratio, 0.0).sum(1, keepdim=True)
    return (kept / mask.sum(1, keepdim=True).clamp(min=1)).expand_as(log_ratio)


def token_weights(
    mask: Tensor, aggregation: str = "token", length: int | None = None, dtype: torch.dtype = torch.float32
) -> Tensor:
    r"""Weights :math:`w` of an aggregation: the loss of a batch is :math:`\sum_{i,t} w_{i,t}\, l_{i,t}`.

    With :math:`|y_i|` tokens in row :math:`i` and :math:`n` rows that have any:

    - ``token``: :math:`1 / \sum_j |y_j|`, each token alike (DAPO, https://arxiv.org/abs/2503.14476, eq. 8);
    - ``sequence``: :math:`1 / (n |y_i|)`, each row alike (GRPO, https://arxiv.org/abs/2402.03300, eq. 3);
    - ``constant``: :math:`1 / (n L)`, no length counts (Dr. GRPO, https://arxiv.org/abs/2503.20783).

    Args:
        mask: bool ``[B, L]``; rows without a token (dropped groups) count nowhere.
        length: :math:`L` of ``constant``; the mask's by default.
        dtype: of the weights.

    Returns:
        ``[B, L]``, 0 outside the mask.

    Raises:
        ValueError: there is no such aggregation.
    """
    is_flag(mask=mask)
    counted = mask.to(dtype)
    lengths = counted.sum(1, keepdim=True)
    rows = (lengths > 0).sum().clamp(min=1)
    if aggregation == "token":
        return counted / lengths.sum().clamp(min=1)
    if aggregation == "sequence":
        return counted / (rows * lengths.clamp(min=1))
    if aggregation == "constant":
        return counted / (rows * (length or mask.shape[1]))
    raise ValueError(f"aggregation={aggregation!r}: give 'token', 'sequence' or 'constant'")


def kl_estimate(log_ratio: Tensor, kind: str = "k3") -> Tensor:
    r"""Estimates of :math:`KL(\pi \| \pi_{ref})` from samples of :math:`\pi`.

    With :math:`d = \log \pi_{ref} - \log \pi`, ``k1`` is :math:`-d`, ``k2`` :math:`d^2 / 2` and ``k3``
    :math:`e^d - d - 1` (Schulman, "Approximating KL divergence", 2020). As a loss, ``k1`` has the gradient of
    :math:`\log \pi` and ignores the reference: subtract it from the reward.

    Args:
        log_ratio: :math:`d`, any shape.

    Returns:
        Same shape, unreduced.

    Raises:
        ValueError: there is no such estimate.
    """
    if kind == "k1":
        return -log_ratio
    if kind == "k2":
        return log_ratio.square() / 2
    if kind == "k3":
        return torch.expm1(log_ratio) - log_ratio
    raise ValueError(f"kl={kind!r}: give 'k1', 'k2' or 'k3'")
