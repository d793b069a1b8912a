"""What actors and critics share: a normalizer, then hidden layers or an encoder."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn
from torchrl.envs import EnvBase

from pgkit.modules.mlp import mlp
from pgkit.modules.sizes import observation_size


def trunk(
    env: EnvBase,
    hidden: Sequence[int],
    activation: type[nn.Module],
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
) -> tuple[list[nn.Module], int]:
    """The modules before a head, and how many features they give for an observation of ``env``."""
    if encoder is None:
        encoder = mlp(observation_size(env), None, hidden, activation)
        features = hidden[-1] if hidden else observation_size(env)
    else:
        with torch.no_grad():
            features = encoder(env.observation_spec_unbatched["observation"].zero().unsqueeze(0)).shape[-1]
    return [encoder] if normalizer is None else [normalizer, encoder], features
