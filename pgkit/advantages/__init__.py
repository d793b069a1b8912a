"""Advantage estimators: a rollout in, the same rollout with ``advantage`` and ``value_target`` out."""

from pgkit.advantages.base import Advantage
from pgkit.advantages.gae import GAE
from pgkit.advantages.group_relative import GroupRelative
from pgkit.advantages.td_lambda import MonteCarlo, NStep, TDLambda
from pgkit.advantages.token_gae import TokenGAE
from pgkit.advantages.vtrace import VTrace

__all__ = ["GAE", "Advantage", "GroupRelative", "MonteCarlo", "NStep", "TDLambda", "TokenGAE", "VTrace"]
