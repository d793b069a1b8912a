"""Value operators: state values, as TorchRL's ``ValueOperator``."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import ValueOperator

from pgkit.modules.mlp import orthogonal
from pgkit.modules.trunk import headed, trunk


def state_value(
    env: EnvBase,
    hidden: Sequence[int] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    *,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
) -> ValueOperator:
    """A state value: ``observation [*B, obs] -> state_value [*B, 1]``. Arguments as in :func:`gaussian_actor`.

    An ``encoder`` shared with the actor is trained by the sum of all losses; ``separate_losses=True`` in the loss
    leaves it to the policy loss alone.
    """
    layers, features = trunk(env, hidden, activation, normalizer, encoder)
    head = orthogonal(nn.Linear(features, 1), 1.0)
    net = headed(layers, head, ["state_value"])
    return ValueOperator(net.module, in_keys=net.in_keys)
