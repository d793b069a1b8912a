"""What sets a loss's coefficient while it trains."""

from pgkit.controllers.adaptive_kl import AdaptiveKL, FixedKL
from pgkit.controllers.schedules import Schedule, constant, cosine, linear
from pgkit.controllers.temperature import FixedTemperature, Temperature

__all__ = [
    "AdaptiveKL",
    "FixedKL",
    "FixedTemperature",
    "Schedule",
    "Temperature",
    "constant",
    "cosine",
    "linear",
]
