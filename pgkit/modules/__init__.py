"""Networks, actors, value operators and normalizers: TensorDict modules and their builders."""

from pgkit.modules.actors import categorical_actor, gaussian_actor, tanh_normal_actor
from pgkit.modules.mlp import mlp
from pgkit.modules.normalizers import ObsNormalizer, ReturnScale
from pgkit.modules.q_values import q_value
from pgkit.modules.values import state_value

__all__ = [
    "ObsNormalizer",
    "ReturnScale",
    "categorical_actor",
    "gaussian_actor",
    "mlp",
    "q_value",
    "state_value",
    "tanh_normal_actor",
]
