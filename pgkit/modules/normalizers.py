"""Running statistics as buffers: they change by an explicit call, and travel with the module that holds them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.modules.sizes import observation_shape


class RunningMoments(nn.Module):
    """Mean and variance over all samples seen so far (Chan et al., 1979, parallel form), as buffers."""

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, shape: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(tuple(shape)))
        self.register_buffer("var", torch.ones(tuple(shape)))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Takes in a batch ``[*B, *shape]``."""
        x = x.reshape(-1, *self.mean.shape).to(self.mean.dtype)
        total = self.count + len(x)
        weight = (len(x) / total).to(x.dtype)  # of the new samples
        delta = x.mean(0) - self.mean
        var = self.var if self.count > 0 else torch.zeros_like(self.var)
        self.var.copy_((1 - weight) * var + weight * x.var(0, correction=0) + weight * (1 - weight) * delta**2)
        self.mean.add_(weight * delta)
        self.count.copy_(total)


class ObsNormalizer(RunningMoments):
    """Normalizes observations: ``(x - mean) / std``, clamped to ``[-clip, clip]``. Identity before the first update.

    Args:
        env: an environment whose ``observation_spec`` has the entry ``observation``, or the shape itself.
        clip: bound of the result.
    """

    def __init__(self, env: EnvBase | Sequence[int], clip: float = 10.0) -> None:
        super().__init__(observation_shape(env) if isinstance(env, EnvBase) else env)
        self.clip = clip

    def forward(self, x: Tensor) -> Tensor:
        """``[*B, *shape]`` to the same shape."""
        return ((x - self.mean) * (self.var + 1e-8).rsqrt()).clamp(-self.clip, self.clip)


class ReturnScale(RunningMoments):
    """Running standard deviation of the returns: lets a critic learn targets of unit scale, rewards untouched.

    Give it to :class:`pgkit.advantages.GAE` (``return_scale=``): the critic's output is then in units of
    :attr:`scale`, the advantage stays in the rewards' unit. Call :meth:`update` once a rollout.
    """

    def __init__(self) -> None:
        super().__init__(())

    @property
    def scale(self) -> Tensor:
        """Standard deviation of the returns, a scalar; 1 before the first update."""
        return (self.var + 1e-8).sqrt()

    @torch.no_grad()
    def update(self, x: Tensor, critic: nn.Module | None = None) -> None:
        """Takes in the ``value_target`` that GAE wrote with this scale, any shape.

        With ``critic``, its last linear layer is rescaled so that its values in the rewards' unit stay (van Hasselt et
        al., 2016, https://arxiv.org/abs/1602.07714). Short rollouts need it: their targets are mostly the critic's own
        values, so a scale that changes them feeds itself.
        """
        before = self.scale
        super().update(x * before)
        if critic is not None:
            head = [module for module in critic.modules() if isinstance(module, nn.Linear)][-1]
            for parameter in head.parameters():
                parameter.mul_(before / self.scale)
