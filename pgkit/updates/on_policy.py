"""The update of on-policy methods: epochs of minibatches over one rollout."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from logging import getLogger
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import Optimizer

from pgkit.checks import LossView, assembly, check_settings, diagram
from pgkit.compiling import check_compile, worth_compiling
from pgkit.constants import Constants
from pgkit.errors import UserError
from pgkit.functional import standardize
from pgkit.updates import restoring
from pgkit.updates.recorded import Block, recorded_block
from pgkit.updates.sequences import as_rows
from pgkit.updates.step import GradientStep


class OnPolicyUpdate:
    """``update(rollout) -> dict[str, float]``: advantage, then epochs of shuffled minibatches.

    Args:
        loss: any TorchRL ``LossModule``; the sum of its ``loss_*`` entries is minimized.
        advantage: block that returns the rollout with ``advantage`` and ``value_target``, pgkit's or TorchRL's; None
            where the rollout has them, the loss needs none, or it was given an estimator (``make_value_estimator``).
        optimizer: any ``torch.optim`` optimizer over the parameters to train.
        epochs: passes over the rollout.
        minibatch_size: rows of a minibatch; the last of an epoch may be smaller. None: the whole rollout.
        sequence_length: for recurrent networks: minibatches are whole sequences of so many steps (``minibatch_size``
            counts steps all the same), and gradients flow back so far. It divides the steps of a rollout. None: single
            rows.
        max_grad_norm: bound of the gradient's norm; None: no bound.
        recompute_advantage: estimate the advantage again before every epoch (Andrychowicz et al., 2021).
        normalize_advantage: standardize each minibatch's advantage here; for losses that do not do it themselves.
        target_kl: stop after the epoch whose ``approx_kl`` (or ``kl_approx``) exceeds 1.5 times this.
        schedules: name to function of the progress in [0, 1]; ``lr`` is the learning rate of all groups, any other
            name an attribute of the loss such as ``entropy_coeff``. Needs ``total_frames``.
        total_frames: frames of the whole training, for schedules and for ``compile="auto"``.
        compile: ``on``, ``off``, or ``auto``: where a C++ compiler is there and at least 30,000 steps are expected, or
            their number is not known. Compiling costs 10 to 40 seconds once and saves about one millisecond a step.
        seed: of the minibatch order; by default drawn from torch's global generator.
    """

    def __init__(
        self,
        loss: nn.Module,
        advantage: Callable[[TensorDictBase], TensorDictBase] | None,
        optimizer: Optimizer,
        *,
        epochs: int = 10,
        minibatch_size: int | None = 64,
        sequence_length: int | None = None,
        max_grad_norm: float | None = 0.5,
        recompute_advantage: bool = False,
        normalize_advantage: bool = False,
        target_kl: float | None = None,
        schedules: Mapping[str, Callable[[float], float]] | None = None,
        total_frames: int | None = None,
        compile: str = "auto",
        seed: int | None = None,
    ) -> None:
        check_compile(compile)
        self.loss, self.advantage, self.optimizer = loss, advantage, optimizer
        self.sequence_length = sequence_length
        self.epochs, self.minibatch_size, self.max_grad_norm = epochs, minibatch_size, max_grad_norm
        self.recompute_advantage, self.normalize_advantage = recompute_advantage, normalize_advantage
        self.target_kl, self.schedules, self.total_frames = target_kl, dict(schedules or {}), total_frames
        self.compile, self.frames = compile, 0
        check_settings(self._view, vars(self))
        self._generator = torch.Generator().manual_seed(int(torch.randint(2**62, ())) if seed is None else seed)
        self._step: GradientStep | None = None
        self._keys: list[Any] = []
        self._old: list[Any] = []  # of these, what losses measure a change from: as before the first epoch
        self._estimate: Block | None = None
        self._held: Constants | None = None  # what a recorded advantage block holds
        self._estimate_seconds = 0.0
        self._batch: TensorDictBase | None = None

    def __call__(self, rollout: TensorDictBase) -> dict[str, float]:
        """Trains on a rollout ``[num_envs, T]``; metrics are means over the minibatches.

        Time is the last dimension: flattened, an advantage would run from one environment into the next.
        """
        self._follow_schedules()
        length = self.sequence_length or 1
        rows = rollout.numel() // length
        size = int(min((self.minibatch_size or rollout.numel()) // length, rows))
        results: list[Tensor] = []
        flat, epoch = rollout, 0
        for epoch in range(1, self.epochs + 1):
            if epoch == 1 or self.recompute_advantage:
                flat = self._flatten(rollout) if epoch == 1 else self._flatten(rollout).update(flat.select(*self._old))
            if self._step is None:
                self._step = self._assemble(rollout, flat, size)
            if epoch == 1:
                self._step.begin()
            order = torch.randperm(rows, generator=self._generator).to(flat.device or "cpu")
            start = len(results)
            for index in order.split(size):
                results.append(self._step(flat, index) if len(index) == size else self._step.eager(flat, index))
            if self.target_kl is not None and self._kl(results[start:]) > 1.5 * self.target_kl:
                break
        self.frames += rollout.numel()
        assert self._step is not None
        means = torch.stack(results).mean(0).tolist()
        metrics = dict(zip(self._step.names, means, strict=True))
        return metrics | {
            "epochs": float(epoch),
            "learning_rate": float(self.optimizer.param_groups[0]["lr"]),
        }

    @property
    def _view(self) -> LossView:
        return LossView(self.loss, self.advantage)

    def __str__(self) -> str:
        size = self.minibatch_size or "the whole rollout"
        norm = f"gradient norm at most {self.max_grad_norm:g}, " if self.max_grad_norm is not None else ""
        step = f"{self.epochs} epochs of minibatches of {size}, {norm}compile {self.compile}"
        return diagram(self, self._view, self.optimizer, step, self._batch)

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far."""
        return self._estimate_seconds + (0.0 if self._step is None else self._step.compile_seconds)

    def state_dict(self) -> dict[str, Any]:
        """Networks, coefficients, optimizer, statistics of the advantage block, minibatch order and frame count."""
        return {
            "loss": self.loss.state_dict(),
            "advantage": self.advantage.state_dict() if isinstance(self.advantage, nn.Module) else {},
            "optimizer": self.optimizer.state_dict(),
            "generator": self._generator.get_state(),
            "frames": self.frames,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`; the compiled step is built again at the next call."""
        restoring.load(self.loss, state["loss"])
        if isinstance(self.advantage, nn.Module):
            restoring.load(self.advantage, state["advantage"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["generator"])
        self.frames = state["frames"]
        self._step = None

    def _flatten(self, rollout: TensorDictBase) -> TensorDictBase:
        """The advantage, then the entries that the loss reads as ``[rows, ...]``."""
        if self.advantage is not None and (self._estimate is None or (self._held and self._held.changed())):
            self._estimate = self._prepare(self.advantage, rollout)
        rollout = self._view.estimated(rollout, self._estimate)
        if self._step is None:
            self._keys = self._view.readable(rollout)
            anchors = [*self._view.keys("value"), *self._view.keys("sample_log_prob")]
            self._old = [key for key in anchors if key in self._keys]
        return as_rows(rollout.select(*self._keys), self.sequence_length)

    def _prepare(self, advantage: Block, rollout: TensorDictBase) -> Block:
        """The advantage block, compiled where it is a good part of the update: a few steps a rollout."""
        few = self.epochs * rollout.numel() <= 4 * (self.minibatch_size or rollout.numel())
        rollouts = None if self.total_frames is None else self.total_frames / rollout.numel()
        if not (few and self._view.recordable and worth_compiling(self.compile, rollouts, 5_000)):
            return advantage
        start = time.perf_counter()
        self._held = Constants(cast(nn.Module, advantage))
        try:
            return recorded_block(cast(TensorDictModuleBase, advantage), rollout)
        except (RuntimeError, KeyError) as error:  # KeyError: it reads an entry that its in_keys leave out
            getLogger("pgkit").debug("the advantage block cannot be recorded: %s", error)
            return advantage
        finally:
            self._estimate_seconds += time.perf_counter() - start

    def _assemble(self, rollout: TensorDictBase, flat: TensorDictBase, size: int) -> GradientStep:
        self._batch = flat[:size]
        resumed = self.frames > 0
        names = assembly(self._view, self.optimizer, self._batch, rollout=rollout, resumed=resumed)
        per_rollout = self.epochs * -(-len(flat) // size)
        steps = None if self.total_frames is None else self.total_frames / flat.numel() * per_rollout
        return GradientStep(
            self.loss,
            self.optimizer,
            names,
            max_grad_norm=self.max_grad_norm,
            before=self._standardize_advantage if self.normalize_advantage else None,
            compile=worth_compiling(self.compile, steps, least_calls=30_000),
            may_fall_back=self.compile == "auto",
        )

    def _follow_schedules(self) -> None:
        for name, schedule in self.schedules.items():
            value = schedule(self.frames / (self.total_frames or 1))
            if name == "lr":
                for group in self.optimizer.param_groups:
                    group["lr"] = value
            else:
                self._view.coefficients()[name].fill_(value)

    def _kl(self, results: list[Tensor]) -> float:
        assert self._step is not None
        names = [name for name in ("approx_kl", "kl_approx") if name in self._step.names]
        if not names:
            raise UserError(f"target_kl needs a loss that reports approx_kl; {self._view.name} does not")
        return float(torch.stack(results).mean(0)[self._step.names.index(names[0])])

    def _standardize_advantage(self, batch: TensorDictBase) -> TensorDictBase:
        key = self._view.key("advantage") or "advantage"
        return batch.copy().set(key, standardize(batch[key]))
