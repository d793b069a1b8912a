"""Action values: an ensemble of critics as one batched network."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.modules.sizes import action_size, observation_size


def q_value(
    env: EnvBase,
    num_critics: int = 2,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    *,
    normalizer: nn.Module | None = None,
) -> TensorDictModule:
    """Action values: ``observation [*B, obs]``, ``action [*B, actions]`` -> ``state_action_value [*B, num_critics]``.

    The critics are the last dimension, so that the result fits a TensorDict of batch size ``B``; all of them are
    evaluated by one batched matrix product a layer. TorchRL's losses stack their critics themselves: give those a
    list of modules with ``num_critics=1``.

    Args:
        env: sizes come from its specs.
        num_critics: independent critics, each with its own initialization.
        hidden: sizes of the hidden layers.
        activation: class of the activation.
        normalizer: applied to the observation first.
    """
    net = CriticEnsemble(observation_size(env) + action_size(env), num_critics, hidden, activation, normalizer)
    return TensorDictModule(net, in_keys=["observation", "action"], out_keys=["state_action_value"])


class CriticEnsemble(nn.Module):
    """``num_critics`` perceptrons side by side: ``[*B, obs], [*B, actions] -> [*B, num_critics]``."""

    def __init__(
        self,
        features: int,
        num_critics: int,
        hidden: Sequence[int],
        activation: type[nn.Module],
        normalizer: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.num_critics, self.normalizer = num_critics, normalizer
        layers: list[nn.Module] = []
        for size in hidden:
            layers += [EnsembleLinear(num_critics, features, size, gain=2**0.5), activation()]
            features = size
        self.layers = nn.Sequential(*layers, EnsembleLinear(num_critics, features, 1, gain=1.0))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        if self.normalizer is not None:
            observation = self.normalizer(observation)
        x = torch.cat([observation, action], -1)
        q = self.layers(x.reshape(-1, x.shape[-1]).expand(self.num_critics, -1, -1))
        return q.squeeze(-1).t().reshape(*x.shape[:-1], self.num_critics)


class EnsembleLinear(nn.Module):
    """``num`` linear layers as one ``baddbmm``: ``[num, B, in] -> [num, B, out]``; orthogonal weights, zero biases."""

    def __init__(self, num: int, in_features: int, out_features: int, gain: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(num, in_features, out_features))
        self.bias = nn.Parameter(torch.zeros(num, 1, out_features))
        for member in self.weight.data:
            nn.init.orthogonal_(member, gain)

    def forward(self, x: Tensor) -> Tensor:
        return torch.baddbmm(self.bias, x, self.weight)
