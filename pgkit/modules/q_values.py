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
from pgkit.modules.groups import AllAgents, Share, agents
from pgkit.modules.sizes import box_action
from pgkit.modules.trunk import Centralized, Trunk, trunk


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
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    centralized: Centralized = False,
    device: torch.device | str | None = None,
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
        group, share_parameters, agent_ids, device: as in :func:`gaussian_actor`; of a group the values are
            ``("agents", "state_action_value") [*B, agents, num_critics]``.
        centralized: an agent's value is of all agents' observations and actions; or, with the key of a state that all
            agents share, of that and all actions.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    actions = box_action(who.action()).shape[0]
    inputs = trunk(who, (), activation, normalizer, encoder, centralized)
    features = inputs.features + actions * (1 if centralized is False else who.number)
    sets = Sets(who.sets) if who.several else None
    copies = num_critics * (len(sets.slots) if sets else 1)
    layers, last = _layers(num_critics, copies, features, hidden, activation, norm, dropout, body)
    layers.append(EnsembleLinear(copies, last, 1 if head is None else head.size, gain=1.0))
    team = None if centralized is False else AllAgents(1 if inputs.after else who.number, flatten=True)
    net = CriticEnsemble(inputs, [layer.to(who.device) for layer in layers], True, head is None, sets, team)
    return QValue(net, [*inputs.keys, who.key("action")], who.key("state_action_value"), num_critics, head)


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
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    centralized: Centralized = False,
    device: torch.device | str | None = None,
) -> QValue:
    """Values of every action: ``observation [*B, obs] -> action_value [*B, num_critics, actions]``.

    All critics are evaluated by one batched matrix product a layer. TorchRL's losses stack their critics themselves:
    give those a list of single ones, ``[*B, actions]`` each.

    Args:
        env: an environment with one discrete action; sizes come from its specs.
        num_critics, hidden, activation, norm, dropout, body, normalizer, encoder, group, share_parameters, agent_ids,
            centralized, device: as in :func:`q_value`; a centralized critic reads no actions.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    spec: Any = who.action()
    actions = getattr(spec.space, "n", None)
    if spec.dtype.is_floating_point or actions is None:
        raise UserError(
            f"discrete_q_value needs one discrete action, the environment's is {type(spec).__name__}: "
            "use modules.q_value for a continuous one"
        )
    inputs = trunk(who, (), activation, normalizer, encoder, centralized)
    sets = Sets(who.sets) if who.several else None
    copies = num_critics * (len(sets.slots) if sets else 1)
    layers, last = _layers(num_critics, copies, inputs.features, hidden, activation, norm, dropout, body)
    layers.append(EnsembleLinear(copies, last, int(actions), gain=1.0))
    net = CriticEnsemble(inputs, [layer.to(who.device) for layer in layers], False, False, sets, None)
    return QValue(net, inputs.keys, who.key("action_value"), num_critics, None)


def _layers(
    num_critics: int,
    copies: int,
    features: int,
    hidden: Sequence[int],
    activation: type[nn.Module],
    norm: Norm | None,
    dropout: float,
    body: Body | None,
) -> Layers:
    check_whole_number(1, num_critics=num_critics)
    if body is not None:
        return body(copies, features)
    return ensemble_mlp(copies, features, hidden, activation, norm, dropout)


class Sets:
    """Agents by their sets of parameters, ``[*B, agents, f]`` to ``[sets, rows, f]`` and back; rows may be repeated.

    Attributes:
        slots: for each set its agents, ``[sets][most]``; the first again where a set has fewer.
        place: for each agent, which of the slots is its own.
    """

    def __init__(self, sets: Sequence[int]) -> None:
        members = [[i for i, own in enumerate(sets) if own == k] for k in range(max(sets) + 1)]
        self.most = max(map(len, members))
        self.slots = [[*agents, *[agents[0]] * (self.most - len(agents))] for agents in members]
        self.place = [own * self.most + members[own].index(i) for i, own in enumerate(sets)]

    def apart(self, x: Tensor) -> Tensor:
        """``[rows, agents, f]`` to ``[sets, most * rows, f]``."""
        return torch.stack([torch.cat([x[:, i] for i in agents]) for agents in self.slots])

    def together(self, x: Tensor) -> Tensor:
        """``[critics * sets, most * rows, size]`` to ``[rows, agents, critics, size]``."""
        slots = x.unflatten(1, (self.most, -1)).unflatten(0, (-1, len(self.slots))).flatten(1, 2)
        return torch.stack([slots[:, i] for i in self.place]).permute(2, 0, 1, 3)


class QValue(TensorDictModule):
    """``num_critics`` action values with their ``head``; a loss can evaluate some of the critics alone."""

    def __init__(
        self, net: CriticEnsemble, in_keys: Sequence[NestedKey], out_key: NestedKey, num_critics: int, head: Head | None
    ) -> None:
        super().__init__(net, in_keys=[*in_keys], out_keys=[out_key])
        self.num_critics, self.head = num_critics, head
        tensors, self._copies = net.layers.state_dict().values(), num_critics * net.num_sets
        self._apart = all(x.dim() > 1 and x.shape[0] == self._copies for x in tensors)

    def members(self, params: Any, index: Tensor | slice) -> Any:
        """Parameters and buffers of the critics ``index`` (``[K]`` or a slice) out of ``params``, to call with.

        None where a layer has tensors without a dimension of the critics in front, which all of them share.
        """
        if not self._apart:
            return None
        inner, sets = params["module"], self._copies // self.num_critics
        shared = {name: value for name, value in inner.items() if name != "layers"}

        def some(x: Tensor) -> Tensor:
            return x[index] if sets == 1 else x.unflatten(0, (-1, sets))[index].flatten(0, 1)

        return TensorDict({"module": {**shared, "layers": inner["layers"].apply(some)}})


class CriticEnsemble(nn.Module):
    """Critics side by side on one observation: ``[*B, critics, size]``, for scalar critics ``[*B, critics]``.

    Args:
        inputs: what turns the observation's entries into features ``[*B, features]``, once for all critics.
        layers: theirs, ``[critics * sets, B, features]`` to ``[critics * sets, B, size]``.
        reads_action: the last input is the action ``[*B, actions]``, and stands beside the features.
        scalar: leave ``size`` out, which is 1.
        sets: which agents of a group share parameters; None: all, or there is one agent.
        team: of a centralized critic, what puts all agents' actions side by side.
    """

    def __init__(
        self,
        inputs: Trunk,
        layers: Sequence[nn.Module],
        reads_action: bool,
        scalar: bool,
        sets: Sets | None = None,
        team: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.encoder = inputs.layers[0] if len(inputs.layers) == 1 else nn.Sequential(*inputs.layers)
        self.layers = nn.Sequential(*layers)
        self.reads_action, self.scalar, self.sets, self.team = reads_action, scalar, sets, team
        self.num_sets = 1 if sets is None else len(sets.slots)
        self.number = inputs.after[0].number if inputs.after else None  # of agents, which share one value

    def forward(self, *entries: Tensor) -> Tensor:
        if self.reads_action:
            action = entries[-1] if self.team is None else self.team(entries[-1])
            x = torch.cat([self.encoder(*entries[:-1]), action], -1)
        else:
            x = self.encoder(*entries)
        last: Any = self.layers[-1]
        critics = last.weight.shape[0] // self.num_sets  # fewer than there are, where only some are evaluated
        if self.sets is None:
            out = self.layers(x.reshape(-1, x.shape[-1]).expand(critics, -1, -1)).transpose(0, 1)
        else:
            rows = self.sets.apart(x.flatten(0, -3)).expand(critics, -1, -1, -1).flatten(0, 1)
            out = self.sets.together(self.layers(rows))
        out = out.reshape(*x.shape[:-1], critics, out.shape[-1])
        if self.number is not None:
            out = out.expand(*x.shape[:-2], self.number, -1, -1)
        return out.squeeze(-1) if self.scalar else out
