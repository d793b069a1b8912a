"""Pure tensor maths: one idea a function, shapes checked, results unreduced."""

from pgkit.functional.checks import is_flag, same_shape
from pgkit.functional.discrete import expected_soft_value, straight_through_sample
from pgkit.functional.distributional import (
    categorical_mean,
    categorical_projection,
    cross_entropy,
    hl_gauss,
    quantile_huber,
    two_hot,
)
from pgkit.functional.returns import discounted_sum, generalized_advantage
from pgkit.functional.smoothing import smoothed_action
from pgkit.functional.soft import (
    bootstrap_target,
    ensemble_mean,
    soft_returns,
    soft_value,
    temperature_loss,
    twin_minimum,
)
from pgkit.functional.subsets import random_subset
from pgkit.functional.surrogates import approx_kl, clip_surrogate
from pgkit.functional.values import clipped_value_loss, explained_variance, value_loss

__all__ = [
    "approx_kl",
    "bootstrap_target",
    "categorical_mean",
    "categorical_projection",
    "clip_surrogate",
    "clipped_value_loss",
    "cross_entropy",
    "discounted_sum",
    "ensemble_mean",
    "expected_soft_value",
    "explained_variance",
    "generalized_advantage",
    "hl_gauss",
    "is_flag",
    "quantile_huber",
    "random_subset",
    "same_shape",
    "smoothed_action",
    "soft_returns",
    "soft_value",
    "straight_through_sample",
    "temperature_loss",
    "twin_minimum",
    "two_hot",
    "value_loss",
]
