"""Exploration: an actor with noise on its actions, for collecting."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type

from pgkit.modules.groups import agents
from pgkit.modules.sizes import box_action


class GaussianExploration(TensorDictModuleBase):
    r"""An actor whose actions carry independent Gaussian noise, :math:`a + h \sigma \epsilon`, clipped to the bounds.

    :math:`h` is half the range of the action, so that ``std`` means the same for every environment (Fujimoto et al.,
    2018, https://arxiv.org/abs/1802.09477). Under TorchRL's ``set_exploration_type`` of any kind but ``RANDOM``, as in
    evaluation, the action is the actor's own.

    Args:
        actor: writes ``action``; :func:`~pgkit.modules.deterministic_actor`.
        env: the bounds come from its specs; with many agents, those of ``group``.
        std: :math:`\sigma`; the buffer ``std`` may be changed while training.
    """

    std: Tensor

    def __init__(
        self, actor: TensorDictModuleBase, env: EnvBase, std: float = 0.1, *, group: str | None = None
    ) -> None:
        super().__init__()
        self.actor, self.bounds = actor, ActionBounds(env, actor, group)
        self.in_keys, self.out_keys = list(actor.in_keys), list(actor.out_keys)
        self.register_buffer("std", torch.tensor(float(std), device=self.bounds.low.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The actor's result, with noise on its ``action``."""
        out = self.actor(tensordict)
        if explores():
            action = out[self.bounds.key]
            out[self.bounds.key] = self.bounds(action, self.std * torch.randn_like(action))
        return out


class ScaledExploration(TensorDictModuleBase):
    r"""A Gaussian actor that draws with :math:`f` times its deviation, for one of several explorers.

    With :math:`f_i = f_0^{1 - i/(N-1)} f_1^{i/(N-1)}` for explorer :math:`i` of :math:`N` they form a ladder, as the
    :math:`\epsilon` of Ape-X do (Horgan et al., 2018, https://arxiv.org/abs/1803.00933). A squashed Gaussian is scaled
    before the tanh. Without exploration, as in evaluation, the action is the actor's own.

    Args:
        actor: writes ``scale`` and draws from it; :func:`~pgkit.modules.tanh_normal_actor`.
        factor: :math:`f`.
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential, factor: float = 1.0) -> None:
        super().__init__()
        self.actor, self.factor = actor, factor
        self.in_keys, self.out_keys = list(actor.in_keys), list(actor.out_keys)
        self.key = next(key for key in actor[-1].in_keys if (key if isinstance(key, str) else key[-1]) == "scale")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The actor's result, drawn with the larger or smaller deviation."""
        *network, draw = self.actor
        for module in network:
            tensordict = module(tensordict)
        if explores():
            tensordict[self.key] = self.factor * tensordict[self.key]
        return draw(tensordict)


class OrnsteinUhlenbeck(TensorDictModuleBase):
    r"""An actor whose actions carry noise that is correlated in time, clipped to the bounds.

    .. math:: n_t = n_{t-1} - \theta\, n_{t-1} + \sigma \epsilon_t, \quad \epsilon_t \sim N(0, 1), \qquad a_t + h\, n_t

    :math:`n` begins at zero with every episode, and :math:`h` is half the range of the action; in the long run
    :math:`n` has the standard deviation :math:`\sigma / \sqrt{1 - (1 - \theta)^2}` (Lillicrap et al., 2016,
    https://arxiv.org/abs/1509.02971). Without exploration, as in evaluation, the action is the actor's own.

    The noise is carried from step to step as a recurrent policy's state is: ``recurrent_state [*B, actions]`` and
    ``is_init [*B, 1]`` are read, ``("next", "recurrent_state")`` is written. pgkit's collectors supply them.

    Args:
        actor: writes ``action``; not recurrent itself.
        env: the bounds come from its specs; with many agents, those of ``group``.
        std: :math:`\sigma`; the buffer ``std`` may be changed while training.
        theta: :math:`\theta`, how fast the noise is forgotten; 1 makes it independent.
    """

    std: Tensor

    def __init__(
        self,
        actor: TensorDictModuleBase,
        env: EnvBase,
        std: float = 0.2,
        theta: float = 0.15,
        *,
        group: str | None = None,
    ) -> None:
        super().__init__()
        self.actor, self.bounds, self.theta = actor, ActionBounds(env, actor, group), theta
        self.state_shape, self.state_size = self.bounds.shape, self.bounds.shape[-1]
        self.state_key: NestedKey = (*self.bounds.group, "recurrent_state")
        self._next_key: NestedKey = ("next", *self.state_key)
        self.in_keys = [*actor.in_keys, "is_init", self.state_key]
        self.out_keys = [*actor.out_keys, self._next_key]
        self.register_buffer("std", torch.tensor(float(std), device=self.bounds.low.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The actor's result, with noise on its ``action`` and the noise's next state."""
        out = self.actor(tensordict)
        if explores():
            before, begins = tensordict[self.state_key], tensordict["is_init"]
            begins = begins.reshape(*begins.shape, *[1] * (before.dim() - begins.dim()))
            noise = (1 - self.theta) * before.masked_fill(begins, 0.0) + self.std * torch.randn_like(before)
            out[self.bounds.key] = self.bounds(out[self.bounds.key], noise)
            out[self._next_key] = noise
        return out


class NoiseRepeat(TensorDictModuleBase):
    r"""A squashed Gaussian actor whose noise stays the same for a random number of steps.

    .. math:: a = \tanh(\mu(s) + \sigma(s) \epsilon), \qquad P(n) \propto n^{-\zeta}, \quad n = 1, \dots, n_{max}

    with :math:`\epsilon \sim N(0, 1)` drawn anew every :math:`n` steps, and :math:`n` with it: long pushes in one
    direction explore further than trembling (FlashSAC, 2026, https://arxiv.org/abs/2604.04539). An episode begins with
    new noise. Without exploration, as in evaluation, the action is the actor's own.

    The noise and the steps left are carried from step to step, as by :class:`OrnsteinUhlenbeck`.

    Args:
        actor: :func:`~pgkit.modules.tanh_normal_actor`, which writes ``loc`` and ``scale``.
        env: the bounds come from its specs.
        zeta: :math:`\zeta`.
        longest: :math:`n_{max}`; 1 draws anew at every step.
    """

    shares: Tensor

    def __init__(self, actor: TensorDictModuleBase, env: EnvBase, zeta: float = 2.0, longest: int = 16) -> None:
        super().__init__()
        self.actor, self.bounds = actor, ActionBounds(env, actor)
        self.state_shape = (self.bounds.shape[-1] + 1,)  # the noise, and the steps that it has left
        self.state_key: NestedKey = (*self.bounds.group, "recurrent_state")
        self._next_key: NestedKey = ("next", *self.state_key)
        self.in_keys = [*actor.in_keys, "is_init", self.state_key]
        self.out_keys = [self.bounds.key, self._next_key]
        weights = torch.arange(1, longest + 1, dtype=torch.float64) ** -zeta
        self.register_buffer("shares", (weights.cumsum(0) / weights.sum()).float().to(self.bounds.low.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The actor's ``action``, of kept noise, and the state of the noise."""
        out = self.actor(tensordict)
        if explores():
            noise, left = tensordict[self.state_key].split([self.state_shape[0] - 1, 1], -1)
            drawn = 1 + (torch.rand_like(left) > self.shares).sum(-1, keepdim=True)
            anew = tensordict["is_init"] | (left < 0.5)
            noise = torch.where(anew, torch.randn_like(noise), noise)
            left = torch.where(anew, drawn, left)
            squashed = (out["loc"] + out["scale"] * noise).tanh()
            middle = (self.bounds.low + self.bounds.high) / 2
            out[self.bounds.key] = self.bounds(middle, squashed)
            out[self._next_key] = torch.cat([noise, left - 1], -1)
        return out


class ActionBounds(nn.Module):
    """``(action, noise) -> action + half_range * noise`` within the bounds of an environment's action.

    It lies where the actor does.
    """

    low: Tensor
    high: Tensor
    half_range: Tensor

    def __init__(self, env: EnvBase, actor: nn.Module, group: str | None = None) -> None:
        super().__init__()
        who, device = agents(env, group), next((p.device for p in actor.parameters()), None)
        spec = box_action(who.action(), needs_bounds=True)
        space: Any = spec.space
        self.group = () if who.name is None else (who.name,)
        self.key, self.shape = who.key("action"), (*[who.number for _ in self.group], *spec.shape)
        for name, x in (("low", space.low), ("high", space.high), ("half_range", (space.high - space.low) / 2)):
            self.register_buffer(name, x.to(device, copy=True))

    def forward(self, action: Tensor, noise: Tensor) -> Tensor:
        return (action + self.half_range * noise).clamp(self.low, self.high)


def explores() -> bool:
    """Whether TorchRL's exploration type asks for noise; without one, it does."""
    return exploration_type() in (ExplorationType.RANDOM, None)
