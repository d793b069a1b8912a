"""Heads of critics: what a critic's outputs stand for, which target they have and how they learn it."""

from pgkit.heads.base import Head
from pgkit.heads.categorical import Bins, Categorical
from pgkit.heads.quantiles import Quantiles
from pgkit.heads.returns import Returns
from pgkit.heads.scalar import Scalar

__all__ = ["Bins", "Categorical", "Head", "Quantiles", "Returns", "Scalar"]
