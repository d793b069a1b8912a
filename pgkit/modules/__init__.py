"""Networks, actors, value operators and normalizers: TensorDict modules and their builders."""

from pgkit.modules.actors import actor, gaussian_actor, tanh_normal_actor
from pgkit.modules.augmentations import random_shift
from pgkit.modules.bodies import Encoder, batch_renorm_mlp, ensemble_mlp, flash, simba
from pgkit.modules.causal_lm import causal_lm, token_value
from pgkit.modules.convolutions import ConvEncoder, Detached, conv_encoder, decoder, image_encoder
from pgkit.modules.deterministic import deterministic_actor
from pgkit.modules.discrete import categorical_actor
from pgkit.modules.encoders import dict_encoder
from pgkit.modules.ensemble import (
    EnsembleBatchRenorm,
    EnsembleDropout,
    EnsembleLayerNorm,
    EnsembleLinear,
    EnsembleRMSNorm,
)
from pgkit.modules.exploration import GaussianExploration, NoiseRepeat, OrnsteinUhlenbeck, ScaledExploration
from pgkit.modules.hugging_face import hugging_face, hugging_face_tokenizer
from pgkit.modules.mlp import mlp
from pgkit.modules.normalizers import ObsNormalizer, ReturnScale, RewardScale
from pgkit.modules.projection import WeightProjection
from pgkit.modules.q_values import QValue, discrete_q_value, q_value
from pgkit.modules.recurrent import gru, lstm
from pgkit.modules.tokens import TokenActor, TokenDistribution, TokenPolicy, TokenValue
from pgkit.modules.trunk import FlatMatrix
from pgkit.modules.values import state_value

__all__ = [
    "ConvEncoder",
    "Detached",
    "Encoder",
    "EnsembleBatchRenorm",
    "EnsembleDropout",
    "EnsembleLayerNorm",
    "EnsembleLinear",
    "EnsembleRMSNorm",
    "FlatMatrix",
    "GaussianExploration",
    "NoiseRepeat",
    "ObsNormalizer",
    "OrnsteinUhlenbeck",
    "QValue",
    "ReturnScale",
    "RewardScale",
    "ScaledExploration",
    "TokenActor",
    "TokenDistribution",
    "TokenPolicy",
    "TokenValue",
    "WeightProjection",
    "actor",
    "batch_renorm_mlp",
    "categorical_actor",
    "causal_lm",
    "conv_encoder",
    "decoder",
    "deterministic_actor",
    "dict_encoder",
    "discrete_q_value",
    "ensemble_mlp",
    "flash",
    "gaussian_actor",
    "gru",
    "hugging_face",
    "hugging_face_tokenizer",
    "image_encoder",
    "lstm",
    "mlp",
    "q_value",
    "random_shift",
    "simba",
    "state_value",
    "tanh_normal_actor",
    "token_value",
]
