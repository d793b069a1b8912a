"""Updates: one call trains on one rollout or on replayed batches, as one compiled graph a step."""

from pgkit.optim import Together
from pgkit.updates.data_parallel import data_parallel
from pgkit.updates.off_policy import OffPolicyUpdate
from pgkit.updates.on_policy import OnPolicyUpdate
from pgkit.updates.ray_learners import RayLearners
from pgkit.updates.step import GradientStep
from pgkit.updates.trust_region import TrustRegionUpdate

__all__ = [
    "GradientStep",
    "OffPolicyUpdate",
    "OnPolicyUpdate",
    "RayLearners",
    "Together",
    "TrustRegionUpdate",
    "data_parallel",
]
