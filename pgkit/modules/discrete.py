"""Actors over discrete actions: one choice, several at once, masked or not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, distributions, nn
from torchrl.data import MultiCategorical as MultiCategoricalSpec
from torchrl.envs import EnvBase
from torchrl.modules import OneHotCategorical, ProbabilisticActor

from pgkit.errors import UserError
from pgkit.modules.actors import probabilistic
from pgkit.modules.groups import Share, agents
from pgkit.modules.trunk import trunk


def categorical_actor(
    env: EnvBase,
    hidden: Sequence[int] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    *,
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
    group: str | None = None,
    share_parameters: Share = True,
    agent_ids: bool = False,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """A categorical distribution over discrete actions; over MultiDiscrete ones, the product of one for each choice.

    The action is an index where the spec is TorchRL's ``Categorical`` (pgkit's environments), one-hot where it is
    ``OneHot`` (TorchRL's ``GymEnv`` by default). Where the environment observes an ``action_mask`` (boolean
    ``[n]``, for MultiDiscrete the masks of all choices side by side), actions that it forbids have probability 0, and
    their logits no gradient; a state that forbids all of them has the uniform distribution. Arguments as in
    :func:`gaussian_actor`.
    """
    who = agents(env, group, share_parameters, agent_ids, device)
    spec: Any = who.action()
    several = isinstance(spec, MultiCategoricalSpec)
    if spec.dtype.is_floating_point or not (several or hasattr(spec.space, "n")):
        raise UserError(
            f"categorical_actor needs a discrete action, the environment's is {spec.__class__.__name__}: "
            "use modules.gaussian_actor or modules.tanh_normal_actor"
        )
    choices = [int(n) for n in spec.nvec.flatten()] if several else [int(spec.space.n)]
    body = trunk(who, hidden, activation, normalizer, encoder)
    head, mask = who.linear(body.features, sum(choices), 0.01), who.key("action_mask")
    masks = [mask] if mask in env.observation_spec.keys(True) else []
    distribution = MultiCategorical if several else OneHotCategorical if spec.shape else Categorical
    kwargs = {"choices": choices} if several else {}
    return probabilistic(who, body, MaskedHead(head) if masks else head, ["logits"], distribution, kwargs, masks)


class Categorical(distributions.Categorical):
    """torch's, whose draws are the same numbers without ``torch.multinomial``'s checks, half of a small policy's cost.

    With :math:`E_i` drawn from the exponential distribution, :math:`\\arg\\max_i p_i / E_i` is :math:`i` with
    probability :math:`p_i`.
    """

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Actions ``[*sample_shape, *B]``."""
        probs = self.probs.expand(*sample_shape, *self.probs.shape)
        return (probs / torch.empty_like(probs).exponential_()).argmax(-1)

    @property
    def deterministic_sample(self) -> Tensor:
        """The likeliest action, ``[*B]``; evaluation takes it."""
        return self.mode


class MaskedHead(nn.Module):
    """Logits ``[*B, n]`` of features and a boolean mask ``[*B, n]``: the least number there is where it is False."""

    def __init__(self, head: nn.Module) -> None:
        super().__init__()
        self.head = head

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        logits = self.head(x)
        return logits.masked_fill(~mask.bool(), torch.finfo(logits.dtype).min)


class MultiCategorical(distributions.Independent):
    """Independent choices: ``logits [*B, sum(choices)]``, actions ``[*B, len(choices)]``, log-probability ``[*B]``."""

    has_rsample = False  # pyright: ignore[reportAssignmentType]  # said by the class, as those of single choices do

    def __init__(self, logits: Tensor, choices: Sequence[int]) -> None:
        least, most = torch.finfo(logits.dtype).min, max(choices)
        parts = [F.pad(x, (0, most - x.shape[-1]), value=least) for x in logits.split(list(choices), -1)]
        super().__init__(Categorical(logits=torch.stack(parts, -2)), 1)

    @property
    def deterministic_sample(self) -> Tensor:
        """The likeliest of each choice."""
        return self.mode
