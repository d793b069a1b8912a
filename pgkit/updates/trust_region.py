"""The update of TRPO and of the natural policy gradient: one step within a trust region, then the critic's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import SGD, Optimizer

from pgkit.checks import LossView, assembly, check_settings, device_of, diagram
from pgkit.compiled import check_compile, choose, undone
from pgkit.functional import conjugate_gradient
from pgkit.optim import parameters
from pgkit.updates.interrupts import interruptible
from pgkit.updates.minibatches import as_rows, frames_of, means, minibatches
from pgkit.updates.state import load, save
from pgkit.updates.step import GradientStep, Grads, grads_of, metrics_of

CRITIC = "loss_critic"


@dataclass(frozen=True)
class Plan:
    """What the first rollout settles.

    Args:
        names: of the policy's metrics.
        critic: its step on a minibatch; None without a critic.
        batch: an example.
    """

    names: Sequence[str]
    critic: GradientStep | None
    batch: TensorDictBase


class TrustRegionUpdate:
    r"""``update(rollout) -> dict[str, float]``: advantage, a step of the policy, epochs of minibatches for the critic.

    .. math::
        \theta' = \theta - \alpha^j \sqrt{\frac{2 \delta}{x^\top F x}}\, x, \qquad F x = \nabla_\theta L

    :math:`F` is the Hessian of the mean :math:`KL(\pi_{old} \| \pi)` at :math:`\pi_{old}`, the Fisher matrix, of which
    only products with vectors are formed (a double backward pass); :math:`x` is from conjugate gradients. :math:`j` is
    the least for which the loss falls and the KL is at most :math:`\delta`; if none up to ``backtracks`` is, or the
    gradient is not finite, the policy stays. Schulman et al., 2015 (https://arxiv.org/abs/1502.05477, appendix C).
    Without the line search (:math:`j = 0`) it is the natural policy gradient with a normalized step (Rajeswaran et al.,
    2017, https://arxiv.org/abs/1703.02660).

    Args:
        loss: a loss with :meth:`~pgkit.losses.PolicyLoss.kl`, e.g. :class:`pgkit.losses.TRPOLoss`; the policy steps on
            the sum of its ``loss_*`` entries but ``loss_critic``, on the whole rollout at once.
        advantage: block that writes ``advantage`` and ``value_target`` into the rollout.
        optimizer: of the critic's parameters; None for a loss without a critic.
        max_kl: :math:`\delta`.
        line_search: False takes the full step.
        cg_steps: steps of conjugate gradients.
        damping: added to the diagonal of :math:`F`.
        backtracks: shorter steps that are tried after the full one.
        backtrack_factor: :math:`\alpha`.
        epochs: passes of the critic over the rollout.
        minibatch_size: rows of the critic's minibatch; None: the whole rollout.
        max_grad_norm: bound of the critic's gradient's norm; None: no bound.
        total_frames: frames of the whole training, for ``compile="auto"``.
        compile: of the critic's step, as in :class:`~pgkit.updates.OnPolicyUpdate`.
        seed: of the minibatch order; by default drawn from torch's global generator.

    The metrics have besides the loss's: ``kl`` of the step that was taken, ``improvement`` of the policy's loss,
    ``step_size`` :math:`\alpha^j` (0: refused), ``cg_error``.
    """

    def __init__(
        self,
        loss: Any,
        advantage: Callable[[TensorDictBase], TensorDictBase] | None,
        optimizer: Optimizer | None = None,
        *,
        max_kl: float = 0.01,
        line_search: bool = True,
        cg_steps: int = 10,
        damping: float = 0.1,
        backtracks: int = 10,
        backtrack_factor: float = 0.8,
        epochs: int = 10,
        minibatch_size: int | None = 64,
        max_grad_norm: float | None = None,
        total_frames: int | None = None,
        compile: str = "auto",
        seed: int | None = None,
    ) -> None:
        check_compile(compile)
        self.loss, self.advantage, self.optimizer = loss, advantage, optimizer
        self.max_kl, self.cg_steps, self.damping = max_kl, cg_steps, damping
        self.sizes = [backtrack_factor**j for j in range(backtracks + 1)] if line_search else [1.0]
        self.line_search = line_search
        self.epochs, self.minibatch_size, self.max_grad_norm = epochs, minibatch_size, max_grad_norm
        self.total_frames, self.compile, self.frames = total_frames, compile, 0
        check_settings(self._view, vars(self))
        self._params = [p for p in loss.actor_network_params.values(True, True) if p.requires_grad]
        self._generator = torch.Generator().manual_seed(int(torch.randint(2**62, ())) if seed is None else seed)
        self.between: Callable[[Grads], Grads] | None = None  # changes the critic's gradients before its step
        self._plan: Plan | None = None

    @interruptible
    def __call__(self, rollout: TensorDictBase) -> dict[str, float]:
        """Trains on a rollout ``[num_envs, T]``: time is the last dimension."""
        estimated = self._view.estimated(rollout, self.advantage)
        flat = as_rows(estimated.select(*self._view.readable(estimated)), None)
        plan = self._plan = self._plan or self._assemble(rollout, flat)
        metrics = self._step_policy(self.loss.keep_distribution(flat.copy()), plan.names)
        if plan.critic is not None:
            metrics |= self._step_critic(plan.critic, flat)
        self.frames += frames_of(rollout)
        return metrics

    def __str__(self) -> str:
        step = f"KL at most {self.max_kl:g}, {'line search' if self.line_search else 'full step'}; then the critic, "
        step += f"{self.epochs} epochs of minibatches of {self.minibatch_size or 'the whole rollout'}"
        return diagram(self, self._view, self.optimizer, step, self._plan and self._plan.batch)

    @property
    def _view(self) -> LossView:
        return LossView(self.loss, self.advantage)

    def _step_policy(self, batch: TensorDictBase, names: Sequence[str]) -> dict[str, float]:
        out = self.loss(batch)
        before = self._policy_loss(out)
        start = torch.cat([p.detach().flatten() for p in self._params])
        gradient = _flat(torch.autograd.grad(before, self._params))
        product = self._fisher(batch)
        x, error = conjugate_gradient(product, gradient, self.cg_steps)
        curvature = (x @ product(x)).clamp_min(torch.finfo(x.dtype).tiny)
        full = -(2 * self.max_kl / curvature).sqrt() * x
        result = {"kl": 0.0, "improvement": 0.0, "step_size": 0.0}
        for size in self.sizes:
            self._assign(start + size * full)
            with torch.no_grad():
                improvement, kl = float(before - self._policy_loss(self.loss(batch))), float(self._mean_kl(batch))
            better = improvement > 0 and kl <= self.max_kl
            if better if self.line_search else full.isfinite().all():
                result = {"kl": kl, "improvement": improvement, "step_size": size}
                break
        else:
            self._assign(start)
        reported = {name: float(out[name].detach()) for name in names}
        return {**reported, **result, "cg_error": float(error)}

    def _fisher(self, batch: TensorDictBase) -> Callable[[Tensor], Tensor]:
        """``v -> (F + damping) v`` at the policy that is kept in the batch."""
        slope = _flat(torch.autograd.grad(self._mean_kl(batch), self._params, create_graph=True))

        def product(v: Tensor) -> Tensor:
            return _flat(torch.autograd.grad(slope @ v, self._params, retain_graph=True)) + self.damping * v

        return product

    def _mean_kl(self, batch: TensorDictBase) -> Tensor:
        """KL divergence from the policy that is kept in the batch, over the rows that count."""
        kl, view = self.loss.kl(batch), self._view
        mask = view.counting(batch, kl, [*view.keys("action"), "action"][0])
        return kl.mean() if mask is None else torch.where(mask, kl, 0.0).sum() / mask.sum().clamp(min=1)

    def _policy_loss(self, out: TensorDictBase) -> Tensor:
        return torch.stack([out[key] for key in out.keys() if key.startswith("loss_") and key != CRITIC]).sum()

    def _assign(self, vector: Tensor) -> None:
        with torch.no_grad():
            for p, part in zip(self._params, vector.split([p.numel() for p in self._params]), strict=True):
                p.copy_(part.view_as(p))

    def _step_critic(self, step: GradientStep, flat: TensorDictBase) -> dict[str, float]:
        size, device, results = int(min(self.minibatch_size or len(flat), len(flat))), device_of(flat), []
        call = step.bind(flat, torch.arange(size, device=device))
        for _ in range(self.epochs):
            for indices in minibatches(len(flat), size, self._generator, device):
                results.append(call(*indices))
        return means(step.names, results)

    def _assemble(self, rollout: TensorDictBase, flat: TensorDictBase) -> Plan:
        rows, critic = len(flat), [] if self.optimizer is None else parameters(self.optimizer)
        size = min(self.minibatch_size or rows, rows)
        every = SGD([*self._params, *critic], lr=0.0)  # who is trained, by the step or by the optimizer
        look = partial(assembly, self._view, every, flat[:size], rollout=rollout, resumed=self.frames > 0)
        names = undone(self.loss.buffers(), look)
        own = [name for name in names if name not in (CRITIC, "explained_variance")]
        if self.optimizer is None:
            return Plan(own, None, flat[:size])
        rest = [name for name in names if name not in own]

        def gradients(data: TensorDictBase, index: Tensor) -> tuple[list[Tensor], Grads]:
            out = self.loss(data[index])
            grads = grads_of(out, critic, only=(CRITIC,))
            return metrics_of(out, rest, like=grads[0]), grads

        steps = None if self.total_frames is None else self.total_frames / rows * self.epochs * -(-rows // size)
        mode = choose(self.compile, steps, least_calls=30_000)
        step = GradientStep(
            gradients,
            self.optimizer,
            rest,
            watch={"the loss": self.loss},
            max_grad_norm=self.max_grad_norm,
            between=self.between,
            mode=mode,
        )
        return Plan(own, step, flat[:size])

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far."""
        step = self._plan and self._plan.critic
        return sum(native.seconds for native in step.native) if step else 0.0

    def state_dict(self) -> dict[str, Any]:
        """Networks, the critic's optimizer, statistics of the advantage block, minibatch order and frame count."""
        return save(self._parts()) | {"generator": self._generator.get_state(), "frames": self.frames}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`; the compiled step is built again at the next call."""
        load(self._parts(), state)
        self._generator.set_state(state["generator"])
        self.frames, self._plan = state["frames"], None

    def _parts(self) -> dict[str, Any]:
        block = self.advantage if isinstance(self.advantage, nn.Module) else None
        return {"loss": self.loss, "advantage": block, "optimizer": self.optimizer}


def _flat(tensors: tuple[Tensor, ...]) -> Tensor:
    return torch.cat([x.reshape(-1) for x in tensors])
