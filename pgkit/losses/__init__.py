"""Losses: one file an algorithm, each a TorchRL ``LossModule``."""

from pgkit.losses.base import PolicyLoss
from pgkit.losses.clip_ppo import ClipPPOLoss
from pgkit.losses.q_base import QLoss
from pgkit.losses.sac import SACLoss

__all__ = ["ClipPPOLoss", "PolicyLoss", "QLoss", "SACLoss"]
