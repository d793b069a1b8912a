"""Action values: an ensemble of critics as one batched network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.errors import UserError, check_whole_number
from pgkit.heads import Head
from pgkit.modules.bodies import Body, Layers, Norm, ensemble_mlp
from pgkit.modules.ensemble import EnsembleLinear
from pgkit.modules.sizes import action_size
from pgkit.modules.trunk import reads, trunk


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
    encoder: nn.Module | None = None,
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
        encoder: one module from the observation, or from the entries that its attribute ``in_keys`` names
            (:func:`~pgkit.modules.dict_encoder`), to the features that all critics read beside the action.
    """
    inputs, features = trunk(env, (), activation, normalizer, encoder)
    layers, last = _layers(num_critics, features + action_size(env), hidden, activation, norm, dropout, body)
    layers.append(EnsembleLinear(num_critics, last, 1 if head is None else head.size, gain=1.0))
    net = CriticEnsemble(inputs, layers, reads_action=True, scalar=head is None)
    return QValue(net, [*reads(inputs[-1]), "action"], "state_action_value", num_critics, head)


def discrete_q_value(
    env: EnvBase,
    num_critics: int = 2,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    *,
    norm: Norm | None = None,
    dropout: float = 0.0,
    body: Body | None = None,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
) -> QValue:
    """Values of every action: ``observation [*B, obs] -> action_value [*B, num_critics, actions]``.

    All critics are evaluated by one batched matrix product a layer. TorchRL's losses stack their critics themselves:
    give those a list of single ones, ``[*B, actions]`` each.

    Args:
        env: an environment with one discrete action; sizes come from its specs.
        num_critics, hidden, activation, norm, dropout, body, normalizer, encoder: as in :func:`q_value`.
    """
    spec = env.action_spec_unbatched
    actions = getattr(spec.space, "n", None)
    if spec.dtype.is_floating_point or actions is None:
        raise UserError(
            f"discrete_q_value needs one discrete action, the environment's is {type(spec).__name__}: "
            "use modules.q_value for a continuous one"
        )
    inputs, features = trunk(env, (), activation, normalizer, encoder)
    layers, last = _layers(num_critics, features, hidden, activation, norm, dropout, body)
    layers.append(EnsembleLinear(num_critics, last, int(actions), gain=1.0))
    net = CriticEnsemble(inputs, layers, reads_action=False, scalar=False)
    return QValue(net, reads(inputs[-1]), "action_value", num_critics, None)


def _layers(
    num: int,
    features: int,
    hidden: Sequence[int],
    activation: type[nn.Module],
    norm: Norm | None,
    dropout: float,
    body: Body | None,
) -> Layers:
    check_whole_number(1, num_critics=num)
    if body is not None:
        return body(num, features)
    return ensemble_mlp(num, features, hidden, activation, norm, dropout)


class QValue(TensorDictModule):
    """``num_critics`` action values with their ``head``; a loss can evaluate some of the critics alone."""

    def __init__(
        self, net: CriticEnsemble, in_keys: Sequence[NestedKey], out_key: str, num_critics: int, head: Head | None
    ) -> None:
        super().__init__(net, in_keys=[*in_keys], out_keys=[out_key])
        self.num_critics, self.head = num_critics, head
        tensors = net.layers.state_dict().values()
        self._apart = all(x.dim() > 1 and x.shape[0] == num_critics for x in tensors)

    def members(self, params: Any, index: Tensor | slice) -> Any:
        """Parameters and buffers of the critics ``index`` (``[K]`` or a slice) out of ``params``, to call with.

        None where a layer has tensors without a dimension of the critics in front, which all of them share.
        """
        if not self._apart:
            return None
        inner = params["module"]
        shared = {name: value for name, value in inner.items() if name != "layers"}
        return TensorDict({"module": {**shared, "layers": inner["layers"].apply(lambda x: x[index])}})


class CriticEnsemble(nn.Module):
    """Critics side by side on one observation: ``[*B, critics, size]``, for scalar critics ``[*B, critics]``.

    Args:
        inputs: what turns the observation's entries into features ``[*B, features]``, once for all critics.
        layers: theirs, ``[critics, B, features]`` to ``[critics, B, size]``.
        reads_action: the last input is the action ``[*B, actions]``, and stands beside the features.
        scalar: leave ``size`` out, which is 1.
    """

    def __init__(
        self, inputs: Sequence[nn.Module], layers: Sequence[nn.Module], reads_action: bool, scalar: bool
    ) -> None:
        super().__init__()
        self.encoder = inputs[0] if len(inputs) == 1 else nn.Sequential(*inputs)
        self.layers = nn.Sequential(*layers)
        self.reads_action, self.scalar = reads_action, scalar

    def forward(self, *entries: Tensor) -> Tensor:
        if self.reads_action:
            x = torch.cat([self.encoder(*entries[:-1]), entries[-1]], -1)
        else:
            x = self.encoder(*entries)
        last: Any = self.layers[-1]
        critics = last.weight.shape[0]  # fewer than there are, where only some members are evaluated
        out = self.layers(x.reshape(-1, x.shape[-1]).expand(critics, -1, -1)).transpose(0, 1)
        return (out.squeeze(-1) if self.scalar else out).reshape(*x.shape[:-1], *out.shape[1 : 2 if self.scalar else 3])
