"""Advantage estimators: a rollout in, the same rollout with ``advantage`` and ``value_target`` out."""

from pgkit.advantages.gae import GAE

__all__ = ["GAE"]
