"""Action values: an ensemble of critics as one batched network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.heads import Head
from pgkit.modules.bodies import Body, Norm, ensemble_mlp
from pgkit.modules.ensemble import EnsembleLinear
from pgkit.modules.sizes import action_size, observation_size


def q_value(
    env: EnvBase,
    num_critics: int = 2,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    *,
    norm: Norm | None = None,
    dropout: float = 0.0,
    body: Body | None = None,
    head: Head | None = None,
    normalizer: nn.Module | None = None,
) -> QValue:
    """Action values: ``observation [*B, obs]``, ``action [*B, actions]`` -> ``state_action_value [*B, num_critics]``.

    The critics are the last dimension, so that the result fits a TensorDict of batch size ``B``; all of them are
    evaluated by one batched matrix product a layer. With a ``head`` the result is ``[*B, num_critics, head.size]``.
    TorchRL's losses stack their critics themselves: give those a list of modules with ``num_critics=1``.

    Args:
        env: sizes come from its specs.
        num_critics: independent critics, each with its own initialization.
        hidden: sizes of the hidden layers.
        activation: class of the activation.
        norm: of each hidden layer, e.g. :class:`~pgkit.modules.EnsembleLayerNorm`.
        dropout: probability of a zero in each hidden layer while training.
        body: replaces the hidden layers and the four arguments before, e.g. ``partial(modules.simba, width=256)``.
        head: what the outputs stand for, one of :mod:`pgkit.heads`; None: one number, the expected return.
        normalizer: applied to the observation first.
    """
    features = observation_size(env) + action_size(env)
    if body is None:
        layers, last = ensemble_mlp(num_critics, features, hidden, activation, norm, dropout)
    else:
        layers, last = body(num_critics, features)
    layers.append(EnsembleLinear(num_critics, last, 1 if head is None else head.size, gain=1.0))
    return QValue(CriticEnsemble(layers, normalizer, scalar=head is None), num_critics, head)


class QValue(TensorDictModule):
    """``num_critics`` action values with their ``head``; a loss can evaluate some of the critics alone."""

    def __init__(self, net: CriticEnsemble, num_critics: int, head: Head | None) -> None:
        super().__init__(net, in_keys=["observation", "action"], out_keys=["state_action_value"])
        self.num_critics, self.head = num_critics, head

    def members(self, params: Any, index: Tensor | slice) -> Any:
        """Parameters and buffers of the critics ``index`` (``[K]`` or a slice) out of ``params``, to call with."""
        inner = params["module"]
        shared = {name: value for name, value in inner.items() if name != "layers"}
        return TensorDict({"module": {**shared, "layers": inner["layers"].apply(lambda x: x[index])}})


class CriticEnsemble(nn.Module):
    """Critics side by side: ``[*B, obs], [*B, actions] -> [*B, critics]``, or ``[*B, critics, size]``."""

    def __init__(self, layers: Sequence[nn.Module], normalizer: nn.Module | None, scalar: bool) -> None:
        super().__init__()
        self.normalizer, self.scalar = normalizer, scalar
        self.layers = nn.Sequential(*layers)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        if self.normalizer is not None:
            observation = self.normalizer(observation)
        x = torch.cat([observation, action], -1)
        last: Any = self.layers[-1]
        critics = last.weight.shape[0]  # fewer than there are, where only some members are evaluated
        out = self.layers(x.reshape(-1, x.shape[-1]).expand(critics, -1, -1)).transpose(0, 1)
        return (out.squeeze(-1) if self.scalar else out).reshape(*x.shape[:-1], *out.shape[1 : 2 if self.scalar else 3])
