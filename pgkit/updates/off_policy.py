"""The update of off-policy methods: a replay buffer that grows, and gradient steps on batches drawn from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer

from pgkit import optim
from pgkit.checks import LossView, assembly, check_settings, diagram, is_loss, result_of
from pgkit.compiled import check_compile, choose, undone
from pgkit.data import ReplayBuffer
from pgkit.errors import UserError
from pgkit.seams import Augmentation
from pgkit.updates.batches import Batches, batches_of
from pgkit.updates.interrupts import interruptible
from pgkit.updates.minibatches import frames_of, means
from pgkit.updates.state import load, save
from pgkit.updates.step import GradientStep, Grads, grads_of, metrics_of, norm_of
from pgkit.updates.targets import averaging, copying


@dataclass(frozen=True)
class Plan:
    """What the first batch settles.

    Args:
        every: the step in which every loss joins.
        critics: the step of the critics' losses alone; the same one where the actor is not delayed.
        batch: an example.
    """

    every: GradientStep
    critics: GradientStep
    batch: TensorDictBase


class OffPolicyUpdate:
    """``update(rollout) -> dict[str, float]``: the rollout goes into the replay, then come the gradient steps due.

    One step is one compiled graph: the gather from the replay, the loss, its gradients, the optimizer, the target
    networks, and the priorities where the replay is prioritized.

    Args:
        loss: any TorchRL off-policy ``LossModule``; the sum of its ``loss_*`` entries is minimized. The target networks
            it holds are averaged here: no ``SoftUpdate`` besides.
        buffer: :class:`pgkit.data.ReplayBuffer`, :class:`pgkit.data.RayReplay` (then only :meth:`train` trains), or
            any TorchRL replay buffer over single transitions.
        optimizer: any ``torch.optim`` optimizer; its groups may have learning rates of their own.
        batch_size: rows of a batch.
        updates_per_step: gradient steps for each frame collected; a fraction such as 0.5 adds up.
        actor_delay: the losses other than the critics' join every so many steps (2 in TD3). The critics' are
            ``loss_qvalue``, ``loss_value``, ``loss_critic``, ``loss_reconstruction``, and what trains nothing but their
            parameters.
        delay_targets: the target networks move only in the steps in which those other losses join, as in TD3.
        tau: share of the trained parameters that the targets take over at each step; or shares by the names of networks
            and of modules in them, ``{"qvalue_network": 0.01, "encoder": 0.05}``, of which the innermost holds.
        learning_starts: frames in the replay before the first step, at least ``batch_size``.
        accumulate: batches whose gradients add up to one optimizer step.
        augment: ``batch -> batch`` that changes a batch before the loss reads it, inside the compiled step.
        project: called with the parameters that a step has trained, inside the compiled step, to bring them back to
            where they belong: :class:`pgkit.modules.WeightProjection`.
        max_grad_norm: bound of the gradient's norm over all parameters; None: no bound.
        total_frames: frames of the whole training, for ``compile="auto"``.
        compile: ``on``, ``off``, or ``auto`` (compile where at least 3,000 steps are expected).

    Raises:
        UserError: ``learning_starts`` is below ``batch_size``, or above what the buffer can keep or ``total_frames``.
    """

    def __init__(
        self,
        loss: nn.Module,
        buffer: ReplayBuffer | Any,
        optimizer: Optimizer,
        *,
        batch_size: int = 256,
        updates_per_step: float = 1.0,
        actor_delay: int = 1,
        delay_targets: bool = False,
        tau: float | Mapping[str, float] = 0.005,
        learning_starts: int = 1_000,
        accumulate: int = 1,
        augment: Augmentation | None = None,
        project: Callable[[Sequence[Tensor]], None] | None = None,
        max_grad_norm: float | None = None,
        total_frames: int | None = None,
        compile: str = "auto",
    ) -> None:
        check_compile(compile)
        self.loss, self.buffer, self.optimizer = loss, buffer, optimizer
        self.batch_size, self.updates_per_step, self.actor_delay = batch_size, updates_per_step, actor_delay
        self.delay_targets, self.accumulate, self.augment, self.project = delay_targets, accumulate, augment, project
        self.tau, self.learning_starts, self.max_grad_norm = tau, learning_starts, max_grad_norm
        self.total_frames, self.compile = total_frames, compile
        self.frames = self.updates = 0
        self.between: Callable[[Grads], Grads] | None = None  # changes the gradients before the optimizer's step
        self._due = 0.0
        self._batches: Batches = batches_of(buffer, loss, batch_size * accumulate)
        one_tau = None if isinstance(tau, Mapping) else tau
        check_settings(LossView(loss), vars(self) | {"capacity": self._batches.capacity, "tau": one_tau})
        self._average, self._copy_statistics = averaging(loss, tau), copying(loss)
        self._plan: Plan | None = None

    @interruptible
    def __call__(self, rollout: TensorDictBase) -> dict[str, float]:
        """Stores a rollout ``[num_envs, T]`` and trains; metrics are means over the steps, none if none was due."""
        self._batches.extend(rollout)
        frames = frames_of(rollout)
        self.frames += frames
        stored = self.buffer.written if isinstance(self.buffer, ReplayBuffer) else len(self.buffer)
        if stored < self.learning_starts:
            return {}
        if len(self.buffer) < self.batch_size:
            if isinstance(self.buffer, ReplayBuffer) and self.buffer.start > 0:
                raise UserError(
                    f"batch_size={self.batch_size} is above the {len(self.buffer)} frames that the replay keeps of "
                    f"{stored:,}: episodes end too often for its {self.buffer.final_rows} final observations; raise "
                    "its capacity (--buffer-size) or ReplayBuffer(final_rows=...)"
                )
            return {}
        self._due += frames * self.updates_per_step
        count = int(self._due)
        self._due -= count
        return self.train(count)

    @interruptible
    def train(self, updates: int) -> dict[str, float]:
        """So many gradient steps on what is stored."""
        results: dict[GradientStep, list[Tensor]] = {}
        calls: dict[GradientStep, Any] = {}
        bound: TensorDictBase | None = None
        self._copy_statistics()  # a normalizer may have moved since
        for data, index in self._batches.draw(updates):
            plan = self._plan = self._plan or self._assemble(data, index)
            step = plan.every if self.updates % self.actor_delay == 0 else plan.critics
            parts = index.split(self.batch_size)
            if data is not bound:
                bound, calls = data, {}
            if step not in calls:
                calls[step] = step.bind(data, parts[0])
            results.setdefault(step, []).append(calls[step](*parts))
            self._batches.drawn()
            self.updates += 1
        return _averaged(results)

    def __str__(self) -> str:
        norm = f"gradient norm at most {self.max_grad_norm:g}, " if self.max_grad_norm is not None else ""
        delay = f"the actor once in {self.actor_delay} steps, " if self.actor_delay > 1 else ""
        rates = self.tau if isinstance(self.tau, Mapping) else {"": self.tau}
        moves = " and ".join(f"{rate:g}{name and f' ({name})'}" for name, rate in rates.items())
        tau = "" if self._average is None else f"targets move by {moves}, "
        step = (
            f"{self.updates_per_step:g} a frame after {self.learning_starts:,} frames, batches of {self.batch_size}, "
            f"{delay}{tau}{norm}compile {self.compile}"
        )
        return diagram(self, self._view, self.optimizer, step, self._plan and self._plan.batch)

    @property
    def _view(self) -> LossView:
        return LossView(self.loss, None, type(self.buffer).__name__)

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far."""
        steps = {self._plan.every, self._plan.critics} if self._plan else set()
        return sum(native.seconds for step in steps for native in step.native)

    def state_dict(self) -> dict[str, Any]:
        """Networks with their targets, coefficients, optimizer, counters. The replay is not in it: it saves itself."""
        return save(self._parts()) | {"counters": (self.frames, self.updates, self._due)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`; with an empty replay, training waits for ``learning_starts`` frames."""
        load(self._parts(), state)
        self.frames, self.updates, self._due = state["counters"]
        self._plan = None

    def _parts(self) -> dict[str, Any]:
        return {"loss": self.loss, "optimizer": self.optimizer}

    def _assemble(self, data: TensorDictBase, index: Tensor) -> Plan:
        batch = self._batches.gather(data, index)
        look = partial(assembly, self._view, self.optimizer, batch, owners_of_gamma=self._batches.settings())
        names = undone(self.loss.buffers(), look)
        every = self._gradient_step(names, None, average=True)
        if self.actor_delay == 1:
            return Plan(every, every, batch)
        only = self._critics(batch)
        critics = self._gradient_step([name for name in names if name in only], only, average=not self.delay_targets)
        return Plan(every, critics, batch)

    def _gradient_step(
        self, names: Sequence[str], only: Mapping[str, Sequence[Tensor]] | None, average: bool
    ) -> GradientStep:
        """A step on all losses, or on those of ``only`` and the parameters that each of these trains."""
        params = optim.parameters(self.optimizer)
        if only is not None:
            kept = {id(p) for reached in only.values() for p in reached}
            params = [p for p in params if id(p) in kept]

        def gradients(data: TensorDictBase, index: Tensor) -> tuple[list[Tensor], Grads]:
            batch = self._batches.gather(data, index)
            if self.augment is not None:
                batch = self.augment(batch)
            out = result_of(self.loss, batch)
            grads = grads_of(out, params, only)
            with torch.no_grad():
                self._batches.write_back(data, index, _usable(batch, self._batches.priority, grads))
            return metrics_of(out, names, like=grads[0]), grads

        def after(finite: Tensor) -> None:
            if self.project is not None:
                before = [p.clone() for p in params]
                self.project(params)
                for p, old in zip(params, before, strict=True):
                    p.copy_(torch.where(finite, p, old))
            if average and self._average is not None:
                self._average(finite)

        steps = None if self.total_frames is None else self.total_frames * self.updates_per_step
        return GradientStep(
            gradients,
            self.optimizer,
            names,
            params=params,
            watch={"the loss": self.loss, "the augmentation": self.augment},
            holds=self._batches.written(),
            max_grad_norm=self.max_grad_norm,
            after=after,
            between=self.between,
            apart=self.accumulate > 1,
            # a step costs 10 times a PPO step, so compiling pays 10 times sooner
            mode=choose(self.compile, steps, least_calls=3_000),
        )

    def _critics(self, batch: TensorDictBase) -> dict[str, list[Tensor]]:
        """The critics' loss entries, and the parameters they train: by name, and whatever trains no others."""
        params = optim.parameters(self.optimizer)

        def trial() -> dict[str, list[Tensor]]:
            out, reached = result_of(self.loss, batch.copy()), {}
            for key in [key for key in out.keys() if is_loss(key) and out[key].requires_grad]:
                grads = torch.autograd.grad(out[key].sum(), params, allow_unused=True, retain_graph=True)
                reached[key] = [p for p, grad in zip(params, grads, strict=True) if grad is not None]
            names = ("loss_qvalue", "loss_value", "loss_critic", "loss_reconstruction")
            named = [key for key in names if key in reached]
            critics = {id(p) for key in named for p in reached[key]}
            return {key: held for key, held in reached.items() if held and all(id(p) in critics for p in held)}

        reached = undone(self.loss.buffers(), trial)
        if not reached:
            raise UserError(f"actor_delay needs a critics' loss (loss_qvalue), {self._view.name} has none")
        return reached


def _usable(batch: TensorDictBase, priority: NestedKey, grads: Grads) -> TensorDictBase:
    """The batch; where the gradient is not finite, its errors are NaN, which leave the priorities as they are."""
    if (errors := batch.get(priority, None)) is None:
        return batch
    return batch.copy().set(priority, torch.where(norm_of(grads).isfinite(), errors, torch.nan))


def _averaged(results: Mapping[GradientStep, Sequence[Tensor]]) -> dict[str, float]:
    """The metrics of both kinds of step; a name that both have is averaged over all steps."""
    metrics: dict[str, list[tuple[int, float]]] = {}
    for step, tensors in results.items():
        for name, mean in means(step.names, tensors).items():
            metrics.setdefault(name, []).append((len(tensors), mean))
    return {
        name: sum(count / sum(count for count, _ in found) * mean for count, mean in found)
        for name, found in metrics.items()
    }
