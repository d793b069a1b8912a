"""Losses: one file an algorithm, each a TorchRL ``LossModule``."""

from pgkit.losses.base import Loss
from pgkit.losses.clip_ppo import ClipPPOLoss
from pgkit.losses.crossq import CrossQLoss
from pgkit.losses.ddpg import DDPGLoss
from pgkit.losses.discrete_sac import DiscreteSACLoss
from pgkit.losses.policy_base import PolicyLoss
from pgkit.losses.q_base import QLoss
from pgkit.losses.redq import REDQLoss
from pgkit.losses.sac import SACLoss
from pgkit.losses.soft_base import SoftQLoss
from pgkit.losses.td3 import TD3Loss
from pgkit.losses.tqc import TQCLoss

__all__ = [
    "ClipPPOLoss",
    "CrossQLoss",
    "DDPGLoss",
    "DiscreteSACLoss",
    "Loss",
    "PolicyLoss",
    "QLoss",
    "REDQLoss",
    "SACLoss",
    "SoftQLoss",
    "TD3Loss",
    "TQCLoss",
]
