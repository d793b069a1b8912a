"""What sets a loss's coefficient while it trains."""

from pgkit.controllers.schedules import Schedule, constant, linear

__all__ = ["Schedule", "constant", "linear"]
