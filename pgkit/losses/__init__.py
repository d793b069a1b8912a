"""Losses: one file an algorithm, each a TorchRL ``LossModule``."""

from pgkit.losses.base import PolicyLoss
from pgkit.losses.clip_ppo import ClipPPOLoss

__all__ = ["ClipPPOLoss", "PolicyLoss"]
