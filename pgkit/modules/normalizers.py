"""Running statistics as buffers: they change by an explicit call, and travel with the module that holds them."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from pgkit.errors import UserError
from pgkit.modules.ensemble import EnsembleLinear
from pgkit.modules.groups import agents


class RunningMoments(nn.Module):
    """Mean and variance over all samples seen so far (Chan et al., 1979, parallel form), as buffers."""

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, shape: Sequence[int], device: torch.device | str | None = None) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(tuple(shape), device=device))
        self.register_buffer("var", torch.ones(tuple(shape), device=device))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64, device=device))

    @torch.no_grad()
    def update(self, x: Tensor, mask: Tensor | None = None) -> None:
        """Takes in a batch ``[*B, *shape]``, of it the rows where ``mask [*B]`` is True."""
        if mask is not None:
            if mask.shape != x.shape[: mask.dim()] or mask.dim() > x.dim() - self.mean.dim():
                raise UserError(
                    f"a mask of shape {tuple(mask.shape)} does not choose among samples of {tuple(x.shape)}"
                )
            x = x[mask]
        x = x.reshape(-1, *self.mean.shape)
        if len(x):
            self._take(x.to(self.mean.dtype))

    def _take(self, x: Tensor) -> None:
        """Takes in samples ``[n, *shape]``."""
        total = self.count + len(x)
        weight = (len(x) / total).to(x.dtype)  # of the new samples
        delta = x.mean(0) - self.mean
        var = self.var if self.count > 0 else torch.zeros_like(self.var)
        self.var.copy_((1 - weight) * var + weight * x.var(0, correction=0) + weight * (1 - weight) * delta**2)
        self.mean.add_(weight * delta)
        self.count.copy_(total)


class ObsNormalizer(RunningMoments):
    r"""Normalizes observations: ``(x - mean) / std``, clamped to ``[-clip, clip]``. Identity before the first update.

    For entries that vary from sample to sample and have no outliers, ``mean`` and ``std`` are those of all samples.
    Two rules keep the others useful:

    - **Outliers.** A sample is clipped to ``clip`` deviations from the mean before it enters the moments. The first
      update has no deviation yet. It takes the batch's median as mean and, as deviation, the distance that nine in ten
      samples keep, divided by 1.645 as for a Gaussian (1 if nine in ten are equal).
    - **Entries that rest** at one value, the first batch's median, and rarely leave it: contact forces, flags. If the
      share :math:`p` of other values is below 1/4, :math:`\sigma^2 = \text{var} \cdot \max(1, 1 / (4 p))`. The rare
      values then come out near 2 and not at :math:`1 / \sqrt p`. An entry that never left its value is not scaled,
      :math:`\sigma = 1`.

    Args:
        env: an environment whose ``observation_spec`` has the entry ``observation``, or the shape itself.
        clip: bound of the result.
        group: a group of agents, whose observations share mean and deviation; found by itself if it is the only one.
        device: where it lives; by default the specs' device.
    """

    rest: Tensor
    moved: Tensor
    spread: Tensor

    def __init__(
        self,
        env: Any,
        clip: float = 10.0,
        *,
        group: str | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        given = isinstance(env, Sequence)  # a shape
        who = None if given else agents(env, group, device=device)
        shape = env if who is None else who.observation(who.key("observation")).shape
        super().__init__(shape, device if who is None else who.device)
        self.clip = clip
        self.register_buffer("rest", torch.zeros_like(self.mean))
        self.register_buffer("moved", torch.zeros_like(self.mean, dtype=torch.float64))  # samples that do not rest
        self.register_buffer("spread", torch.ones_like(self.mean))  # the deviation squared

    def forward(self, x: Tensor) -> Tensor:
        """``[*B, *shape]`` to the same shape."""
        return ((x - self.mean) * (self.spread + 1e-8).rsqrt()).clamp(-self.clip, self.clip)

    def _take(self, x: Tensor) -> None:
        if self.count > 0:
            middle, deviation = self.mean, self.spread.sqrt()
        else:
            self.rest.copy_(_order(x, 0.5))  # median() is wrong on expanded tensors
            middle, deviation = self.rest, _typical_distance(x - self.rest)
        self.moved.add_((x != self.rest).sum(0))
        super()._take(x.clamp(middle - self.clip * deviation, middle + self.clip * deviation))
        rarity = (self.count / (4 * self.moved)).clamp_min(1).to(self.var.dtype)
        self.spread.copy_(torch.where(self.moved > 0, self.var * rarity, 1.0))


def _order(x: Tensor, share: float) -> Tensor:
    """The sample of ``x [n, ...]`` that this share of the others does not exceed."""
    return x.kthvalue(floor(share * (len(x) - 1)) + 1, 0).values


def _typical_distance(x: Tensor) -> Tensor:
    """The size that nine in ten of ``x [n, ...]`` do not exceed, over 1.645; 1 where that is 0."""
    size = _order(x.abs(), 0.9)
    return torch.where(size > 0, size / 1.645, 1.0)


class ReturnScale(RunningMoments):
    """Running standard deviation of the returns: lets a critic learn targets of unit scale, rewards untouched.

    Give it to :class:`pgkit.advantages.GAE` (``return_scale=``): the critic's output is then in units of
    :attr:`scale`, the advantage stays in the rewards' unit. Call :meth:`update` once a rollout.

    One outlier does not spoil the scale: a return is clipped to ``clip`` deviations from the mean. In the first update
    the batch's median and typical distance stand for mean and deviation, as in :class:`ObsNormalizer`. For a reward of
    your own, such as an intrinsic one, use :class:`RewardScale`.

    Args:
        clip: far above the spread of rewards that are rare but real.
        shape: ``()``, one scale for all; ``(agents, 1)``, one for each agent of a group.
        device: where it lives.
    """

    def __init__(
        self, shape: Sequence[int] = (), *, clip: float = 1_000.0, device: torch.device | str | None = None
    ) -> None:
        super().__init__(shape, device)
        self.clip = clip

    def _take(self, x: Tensor) -> None:
        if self.count > 0:
            middle, deviation = self.mean, self.scale
        else:
            middle = _order(x, 0.5)
            deviation = _typical_distance(x - middle)
        super()._take(x.clamp(middle - self.clip * deviation, middle + self.clip * deviation))

    @property
    def scale(self) -> Tensor:
        """Standard deviation of the returns, a scalar or of the shape; 1 before the first update."""
        return (self.var + 1e-8).sqrt()

    @torch.no_grad()
    def update(self, x: Tensor, critic: nn.Module | None = None, mask: Tensor | None = None) -> None:
        """Takes in the ``value_target`` that GAE wrote with this scale, ``[*B, *shape]``, where ``mask`` is True.

        With ``critic``, its last linear layer is rescaled so that its values in the rewards' unit stay (van Hasselt et
        al., 2016, https://arxiv.org/abs/1602.07714). Short rollouts need it: their targets are mostly the critic's own
        values, so a scale that changes them feeds itself.

        Raises:
            UserError: a scale for each agent, and a critic whose last layer all agents share.
        """
        before = self.scale
        super().update(x * before, mask)
        if critic is not None:
            head = [module for module in critic.modules() if isinstance(module, nn.Linear | EnsembleLinear)][-1]
            factor = before / self.scale
            if factor.numel() > 1:
                if not isinstance(head, EnsembleLinear) or len(head.weight) != factor.numel():
                    raise UserError(
                        f"the scale has {factor.numel()} agents, the critic's last layer is one for all of them: use "
                        "ReturnScale() with it, or state_value(..., share_parameters=False)"
                    )
                factor = factor.reshape(-1, 1, 1)
            for parameter in head.parameters():
                parameter.mul_(factor)


class RewardScale(nn.Module):
    r"""Divides rewards so that discounted returns have a deviation of 1 at most and never leave ``[-g_max, g_max]``.

    .. math:: r \leftarrow \frac{r}{\max(\sigma_G, \max |G| / g_{max})}, \qquad G_t = r_t + \gamma\, G_{t-1}

    :math:`G` begins anew with every episode, as in SimbaV2 (Lee et al., 2025, https://arxiv.org/abs/2502.15280) and
    FlashSAC (https://arxiv.org/abs/2604.04539). A categorical critic can then have fixed bins. Rewards are stored
    unchanged; each batch divides them by the present scale. Give it to :class:`pgkit.updates.OffPolicyUpdate`
    (``augment=``), and call :meth:`update` once a rollout.

    Args:
        num_envs: environments of a rollout.
        gamma: the loss's discount.
        g_max: bound of the returns.
        device: where it lives.
    """

    returns: Tensor
    largest: Tensor

    def __init__(
        self, num_envs: int, gamma: float = 0.99, g_max: float = 5.0, *, device: torch.device | str | None = None
    ) -> None:
        super().__init__()
        self.gamma, self.g_max, self.moments = gamma, g_max, RunningMoments((), device)
        self.register_buffer("returns", torch.zeros(num_envs, device=device))  # of the episodes that run now
        self.register_buffer("largest", torch.zeros((), device=device))

    @property
    def scale(self) -> Tensor:
        """What rewards are divided by, a scalar."""
        return torch.maximum((self.moments.var + 1e-8).sqrt(), self.largest / self.g_max)

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """A batch with divided rewards; the one that is given stays."""
        out = batch.copy()
        out["next", "reward"] = batch["next", "reward"] / self.scale
        return out

    @torch.no_grad()
    def update(self, rollout: TensorDictBase) -> None:
        """Takes in a rollout ``[num_envs, T]``; steps that its ``("collector", "mask")`` leaves out are none."""
        mask = rollout.get(("collector", "mask"), None)
        rewards, done = (rollout["next", name].squeeze(-1).unbind(1) for name in ("reward", "done"))
        seen = []
        for reward, ended in zip(rewards, done, strict=True):
            seen.append(reward + self.gamma * self.returns)
            self.returns.copy_(seen[-1] * ~ended)
        returns = torch.stack(seen)
        self.moments.update(returns, None if mask is None else mask.t())
        self.largest.copy_(torch.maximum(self.largest, returns.abs().amax()))
