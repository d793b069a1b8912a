"""Losses: one file an algorithm, each a TorchRL ``LossModule``."""

from pgkit.losses.a2c import A2CLoss
from pgkit.losses.base import Loss
from pgkit.losses.clip_ppo import ClipPPOLoss
from pgkit.losses.crossq import CrossQLoss
from pgkit.losses.ddpg import DDPGLoss
from pgkit.losses.discrete_sac import DiscreteSACLoss
from pgkit.losses.grpo import GRPOLoss
from pgkit.losses.kl_pen_ppo import KLPENPPOLoss
from pgkit.losses.policy_base import ActorCriticLoss, PolicyLoss
from pgkit.losses.q_base import QLoss
from pgkit.losses.reconstruction import ReconstructionLoss
from pgkit.losses.redq import REDQLoss
from pgkit.losses.reinforce import ReinforceLoss
from pgkit.losses.sac import SACLoss
from pgkit.losses.sft import SFTLoss
from pgkit.losses.soft_base import SoftQLoss
from pgkit.losses.sum import Sum
from pgkit.losses.td3 import TD3Loss
from pgkit.losses.tqc import TQCLoss
from pgkit.losses.trpo import TRPOLoss

__all__ = [
    "A2CLoss",
    "ActorCriticLoss",
    "ClipPPOLoss",
    "CrossQLoss",
    "DDPGLoss",
    "DiscreteSACLoss",
    "GRPOLoss",
    "KLPENPPOLoss",
    "Loss",
    "PolicyLoss",
    "QLoss",
    "REDQLoss",
    "ReconstructionLoss",
    "ReinforceLoss",
    "SACLoss",
    "SFTLoss",
    "SoftQLoss",
    "Sum",
    "TD3Loss",
    "TQCLoss",
    "TRPOLoss",
]
