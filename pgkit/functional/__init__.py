"""Pure tensor maths: one idea a function, shapes checked, results unreduced."""

from pgkit.functional.adaptation import adapted_coefficient
from pgkit.functional.checks import is_flag, listed, same_shape
from pgkit.functional.conjugate_gradient import conjugate_gradient
from pgkit.functional.discrete import expected_soft_value, straight_through_sample
from pgkit.functional.distributional import (
    categorical_mean,
    categorical_projection,
    cross_entropy,
    hl_gauss,
    quantile_huber,
    two_hot,
)
from pgkit.functional.group_relative import batch_relative, group_relative, has_spread, leave_one_out
from pgkit.functional.images import quantized_pixels, shift_images
from pgkit.functional.returns import discounted_sum, generalized_advantage
from pgkit.functional.smoothing import smoothed_action
from pgkit.functional.soft import (
    bootstrap_target,
    ensemble_mean,
    temperature_loss,
    twin_minimum,
)
from pgkit.functional.subsets import random_subset
from pgkit.functional.surrogates import (
    approx_kl,
    clip_surrogate,
    dual_clip_surrogate,
    policy_gradient,
    quadratic_surrogate,
    ratio_surrogate,
    rollback_surrogate,
)
from pgkit.functional.td_lambda import from_start, lambda_return, n_step_return
from pgkit.functional.tokens import kl_estimate, sequence_log_ratio, token_weights
from pgkit.functional.values import clipped_value_loss, explained_variance, standardize, value_loss
from pgkit.functional.vtrace import vtrace

__all__ = [
    "adapted_coefficient",
    "approx_kl",
    "batch_relative",
    "bootstrap_target",
    "categorical_mean",
    "categorical_projection",
    "clip_surrogate",
    "clipped_value_loss",
    "conjugate_gradient",
    "cross_entropy",
    "discounted_sum",
    "dual_clip_surrogate",
    "ensemble_mean",
    "expected_soft_value",
    "explained_variance",
    "from_start",
    "generalized_advantage",
    "group_relative",
    "has_spread",
    "hl_gauss",
    "is_flag",
    "kl_estimate",
    "lambda_return",
    "leave_one_out",
    "listed",
    "n_step_return",
    "policy_gradient",
    "quadratic_surrogate",
    "quantile_huber",
    "quantized_pixels",
    "random_subset",
    "ratio_surrogate",
    "rollback_surrogate",
    "same_shape",
    "sequence_log_ratio",
    "shift_images",
    "smoothed_action",
    "standardize",
    "straight_through_sample",
    "temperature_loss",
    "token_weights",
    "twin_minimum",
    "two_hot",
    "value_loss",
    "vtrace",
]
