"""The update of TRPO and of the natural policy gradient: one step within a trust region, then the critic's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import SGD, Optimizer

from pgkit.checks import LossView, assembly, check_settings, diagram
from pgkit.compiling import check_compile, worth_compiling
from pgkit.functional import conjugate_gradient
from pgkit.optim import parameters
from pgkit.updates import restoring
from pgkit.updates.sequences import as_rows
from pgkit.updates.step import GradientStep

CRITIC = "loss_critic"


class TrustRegionUpdate:
    r"""``update(rollout) -> dict[str, float]``: advantage, a step of the policy, epochs of minibatches for the critic.

    .. math::
        \theta' = \theta - \alpha^j \sqrt{\frac{2 \delta}{x^\top F x}}\, x, \qquad F x = \nabla_\theta L

    :math:`F` is the Hessian of the mean :math:`KL(\pi_{old} \| \pi)` at :math:`\pi_{old}`, the Fisher matrix, of which
    only products with vectors are formed (a double backward pass); :math:`x` is from conjugate gradients. :math:`j` is
    the least for which the loss falls and the KL is at most :math:`\delta`; if none up to ``backtracks`` is, the policy
    stays. Schulman et al., 2015 (https://arxiv.org/abs/1502.05477, appendix C). Without the line search (:math:`j = 0`)
    it is the natural policy gradient with a normalized step (Rajeswaran et al., 2017, https://arxiv.org/abs/1703.02660).

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
        self._step: GradientStep | None = None
        self._names: list[str] = []
        self._batch: TensorDictBase | None = None

    def __call__(self, rollout: TensorDictBase) -> dict[str, float]:
        """Trains on a rollout ``[num_envs, T]``: time is the last dimension."""
        estimated = self._view.estimated(rollout, self.advantage)
        flat = as_rows(estimated.select(*self._view.readable(estimated)), None)
        if not self._names:
            self._assemble(rollout, flat)
        metrics = self._step_policy(self.loss.keep_distribution(flat.copy()))
        metrics |= self._step_critic(flat)
        self.frames += len(flat)
        return metrics

    @property
    def _view(self) -> LossView:
        return LossView(self.loss, self.advantage)

    def __str__(self) -> str:
        step = f"KL at most {self.max_kl:g}, {'line search' if self.line_search else 'full step'}; then the critic, "
        step += f"{self.epochs} epochs of minibatches of {self.minibatch_size or 'the whole rollout'}"
        return diagram(self, self._view, self.optimizer, step, self._batch)

    def _step_policy(self, batch: TensorDictBase) -> dict[str, float]:
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
                improvement, kl = float(before - self._policy_loss(self.loss(batch))), float(self.loss.kl(batch).mean())
            if not self.line_search or (improvement > 0 and kl <= self.max_kl):
                result = {"kl": kl, "improvement": improvement, "step_size": size}
                break
        else:
            self._assign(start)
        reported = {name: float(out[name].detach()) for name in self._names}
        return {**reported, **result, "cg_error": float(error)}

    def _fisher(self, batch: TensorDictBase) -> Callable[[Tensor], Tensor]:
        """``v -> (F + damping) v`` at the policy that is kept in the batch."""
        slope = _flat(torch.autograd.grad(self.loss.kl(batch).mean(), self._params, create_graph=True))

        def product(v: Tensor) -> Tensor:
            return _flat(torch.autograd.grad(slope @ v, self._params, retain_graph=True)) + self.damping * v

        return product

    def _policy_loss(self, out: TensorDictBase) -> Tensor:
        return torch.stack([out[key] for key in out.keys() if key.startswith("loss_") and key != CRITIC]).sum()

    def _assign(self, vector: Tensor) -> None:
        with torch.no_grad():
            for p, part in zip(self._params, vector.split([p.numel() for p in self._params]), strict=True):
                p.copy_(part.view_as(p))

    def _step_critic(self, flat: TensorDictBase) -> dict[str, float]:
        if self._step is None:
            return {}
        self._step.begin()
        size, results = int(min(self.minibatch_size or len(flat), len(flat))), []
        for _ in range(self.epochs):
            for index in torch.randperm(len(flat), generator=self._generator).to(flat.device or "cpu").split(size):
                results.append(self._step(flat, index) if len(index) == size else self._step.eager(flat, index))
        return dict(zip(self._step.names, torch.stack(results).mean(0).tolist(), strict=True))

    def _assemble(self, rollout: TensorDictBase, flat: TensorDictBase) -> None:
        rows, critic = len(flat), [] if self.optimizer is None else parameters(self.optimizer)
        size = min(self.minibatch_size or rows, rows)
        self._batch = flat[:size]
        every = SGD([*self._params, *critic], lr=0.0)  # who is trained, by the step or by the optimizer
        names = assembly(self._view, every, self._batch, rollout=rollout, resumed=self.frames > 0)
        self._names = [name for name in names if name not in (CRITIC, "explained_variance")]
        if self.optimizer is None:
            return
        steps = None if self.total_frames is None else self.total_frames / rows * self.epochs * -(-rows // size)
        self._step = GradientStep(
            self.loss,
            self.optimizer,
            [name for name in names if name not in self._names],
            max_grad_norm=self.max_grad_norm,
            only={CRITIC: critic},
            compile=worth_compiling(self.compile, steps, least_calls=30_000),
            may_fall_back=self.compile == "auto",
        )

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far."""
        return 0.0 if self._step is None else self._step.compile_seconds

    def state_dict(self) -> dict[str, Any]:
        """Networks, the critic's optimizer, statistics of the advantage block, minibatch order and frame count."""
        return {
            "loss": self.loss.state_dict(),
            "advantage": self.advantage.state_dict() if isinstance(self.advantage, nn.Module) else {},
            "optimizer": {} if self.optimizer is None else self.optimizer.state_dict(),
            "generator": self._generator.get_state(),
            "frames": self.frames,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`; the compiled step is built again at the next call."""
        restoring.load(self.loss, state["loss"])
        if isinstance(self.advantage, nn.Module):
            restoring.load(self.advantage, state["advantage"])
        if self.optimizer is not None:
            self.optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["generator"])
        self.frames, self._step, self._names = state["frames"], None, []


def _flat(tensors: tuple[Tensor, ...]) -> Tensor:
    return torch.cat([x.reshape(-1) for x in tensors])
