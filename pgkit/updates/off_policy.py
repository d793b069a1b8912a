"""The update of off-policy methods: a replay buffer that grows, and gradient steps on batches drawn from it."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer

from pgkit import optim
from pgkit.checks import LossView, assembly, check_settings, diagram, is_loss
from pgkit.compiling import check_compile, worth_compiling
from pgkit.data import ReplayBuffer
from pgkit.errors import UserError
from pgkit.updates import restoring
from pgkit.updates.batches import Batches, OwnBatches, TorchRLBatches
from pgkit.updates.step import GradientStep
from pgkit.updates.targets import averaging, copying


class OffPolicyUpdate:
    """``update(rollout) -> dict[str, float]``: the rollout goes into the replay, then come the gradient steps due.

    One step is one compiled graph: the gather from the replay, the loss, its gradients, the optimizer, the target
    networks, and the priorities where the replay is prioritized.

    Args:
        loss: any TorchRL off-policy ``LossModule``; the sum of its ``loss_*`` entries is minimized. The target networks
            it holds are averaged here: no ``SoftUpdate`` besides.
        buffer: :class:`pgkit.data.ReplayBuffer` or any TorchRL replay buffer over single transitions.
        optimizer: any ``torch.optim`` optimizer; its groups may have learning rates of their own.
        batch_size: rows of a batch.
        updates_per_step: gradient steps for each frame collected; a fraction such as 0.5 adds up.
        actor_delay: the losses other than the critics' join every so many steps (2 in TD3). The critics' are
            ``loss_qvalue``, ``loss_value``, ``loss_critic``, and what trains nothing but their parameters.
        delay_targets: the target networks move only in the steps in which those other losses join, as in TD3.
        tau: share of the trained parameters that the targets take over at each step.
        learning_starts: frames in the replay before the first step, at least ``batch_size``.
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
        tau: float = 0.005,
        learning_starts: int = 1_000,
        max_grad_norm: float | None = None,
        total_frames: int | None = None,
        compile: str = "auto",
    ) -> None:
        check_compile(compile)
        self.loss, self.buffer, self.optimizer = loss, buffer, optimizer
        self.batch_size, self.updates_per_step, self.actor_delay = batch_size, updates_per_step, actor_delay
        self.delay_targets = delay_targets
        self.tau, self.learning_starts, self.max_grad_norm = tau, learning_starts, max_grad_norm
        self.total_frames, self.compile = total_frames, compile
        self.frames = self.updates = 0
        self._due = 0.0
        self._batch: TensorDictBase | None = None
        own = isinstance(buffer, ReplayBuffer)
        self._batches: Batches = (OwnBatches if own else TorchRLBatches)(buffer, loss, batch_size)
        check_settings(LossView(loss), vars(self) | {"capacity": self._batches.capacity})
        self._average, self._copy_statistics = averaging(loss, tau), copying(loss)
        self._steps: dict[bool, GradientStep] = {}

    def __call__(self, rollout: TensorDictBase) -> dict[str, float]:
        """Stores a rollout ``[num_envs, T]`` and trains; metrics are means over the steps, none if none was due."""
        self._batches.extend(rollout)
        self.frames += rollout.numel()
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
        self._due += rollout.numel() * self.updates_per_step
        count = int(self._due)
        self._due -= count
        return self.train(count)

    def train(self, updates: int) -> dict[str, float]:
        """So many gradient steps on what is stored."""
        results: dict[bool, list[Tensor]] = {True: [], False: []}
        self._copy_statistics()  # a normalizer may have moved since
        for data, index in self._batches.draw(updates):
            whole = self.updates % self.actor_delay == 0
            if not self._steps:
                self._assemble(data, index)
            if not results[whole]:
                self._steps[whole].begin()
            results[whole].append(self._steps[whole](data, index))
            self._batches.drawn()
            self.updates += 1
        metrics: dict[str, float] = {}
        for whole in (False, True):  # a name that both kinds of step have is averaged over all of them
            if results[whole]:
                means = torch.stack(results[whole]).mean(0) if len(results[whole]) > 1 else results[whole][0]
                share = len(results[whole]) / (len(results[True]) + len(results[False]))
                for name, mean in zip(self._steps[whole].names, means.tolist(), strict=True):
                    both = share < 1 and all(name in self._steps[kind].names for kind in (True, False))
                    metrics[name] = metrics.get(name, 0.0) + (share if both else 1.0) * mean
        return metrics

    @property
    def _view(self) -> LossView:
        return LossView(self.loss, None, type(self.buffer).__name__)

    def __str__(self) -> str:
        norm = f"gradient norm at most {self.max_grad_norm:g}, " if self.max_grad_norm is not None else ""
        delay = f"the actor once in {self.actor_delay} steps, " if self.actor_delay > 1 else ""
        tau = "" if self._average is None else f"targets move by {self.tau:g}, "
        step = (
            f"{self.updates_per_step:g} a frame after {self.learning_starts:,} frames, batches of {self.batch_size}, "
            f"{delay}{tau}{norm}compile {self.compile}"
        )
        return diagram(self, self._view, self.optimizer, step, self._batch)

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far."""
        return sum(step.compile_seconds for step in self._steps.values())

    def state_dict(self) -> dict[str, Any]:
        """Networks with their targets, coefficients, optimizer, counters. The replay is not in it: it saves itself."""
        return {
            "loss": self.loss.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "counters": (self.frames, self.updates, self._due),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`; with an empty replay, training waits for ``learning_starts`` frames."""
        restoring.load(self.loss, state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.frames, self.updates, self._due = state["counters"]
        self._steps = {}

    def _assemble(self, data: TensorDictBase, index: Tensor) -> None:
        batch = self._batches.gather(data, index)
        names = assembly(self._view, self.optimizer, batch, owners_of_gamma=self._batches.settings())
        self._batch = batch
        steps = None if self.total_frames is None else self.total_frames * self.updates_per_step
        settings: dict[str, Any] = {
            "max_grad_norm": self.max_grad_norm,
            "after": self._average,
            "gather": self._batches.gather,
            "write_back": self._batches.write_back,
            # a step costs 10 times a PPO step, so compiling pays 10 times sooner
            "compile": worth_compiling(self.compile, steps, least_calls=3_000),
            "written": self._batches.written(),
            "may_fall_back": self.compile == "auto",
        }
        self._steps[True] = GradientStep(self.loss, self.optimizer, names, **settings)
        if self.actor_delay > 1:
            only = self._critics(batch)
            names = [name for name in names if name in only]
            settings["after"] = None if self.delay_targets else self._average
            self._steps[False] = GradientStep(self.loss, self.optimizer, names, only=only, **settings)

    def _critics(self, batch: TensorDictBase) -> dict[str, list[Tensor]]:
        """The critics' loss entries, and the parameters they train: by name, and whatever trains no others."""
        params = optim.parameters(self.optimizer)

        def trial() -> dict[str, list[Tensor]]:
            out, reached = self.loss(batch.copy()), {}
            for key in [key for key in out.keys() if is_loss(key) and out[key].requires_grad]:
                grads = torch.autograd.grad(out[key].sum(), params, allow_unused=True, retain_graph=True)
                reached[key] = [p for p, grad in zip(params, grads, strict=True) if grad is not None]
            named = [key for key in ("loss_qvalue", "loss_value", "loss_critic") if key in reached]
            critics = {id(p) for key in named for p in reached[key]}
            return {key: held for key, held in reached.items() if held and all(id(p) in critics for p in held)}

        reached = restoring.undone(self.loss.buffers(), trial)
        if not reached:
            raise UserError(f"actor_delay needs a critics' loss (loss_qvalue), {self._view.name} has none")
        return reached
