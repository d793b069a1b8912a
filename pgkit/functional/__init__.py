"""Pure tensor maths: one idea a function, shapes checked, results unreduced."""

from pgkit.functional.checks import is_flag, same_shape
from pgkit.functional.returns import discounted_sum, generalized_advantage
from pgkit.functional.soft import bootstrap_target, soft_value, temperature_loss, twin_minimum
from pgkit.functional.surrogates import approx_kl, clip_surrogate
from pgkit.functional.values import clipped_value_loss, explained_variance, value_loss

__all__ = [
    "approx_kl",
    "bootstrap_target",
    "clip_surrogate",
    "clipped_value_loss",
    "discounted_sum",
    "explained_variance",
    "generalized_advantage",
    "is_flag",
    "same_shape",
    "soft_value",
    "temperature_loss",
    "twin_minimum",
    "value_loss",
]
