"""The update of on-policy methods: epochs of minibatches over one rollout."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.optim import Optimizer

from pgkit.checks import LossView, assembly, check_settings, device_of, diagram, result_of
from pgkit.compiled import Compiled, Mode, check_compile, choose, compiled, undone
from pgkit.errors import UserError
from pgkit.functional import standardize
from pgkit.optim import parameters
from pgkit.seams import Augmentation
from pgkit.updates.interrupts import interruptible
from pgkit.updates.learners import Alone, Learners
from pgkit.updates.minibatches import as_rows, means, minibatches
from pgkit.updates.state import load, save
from pgkit.updates.step import GradientStep, Grads, grads_of, metrics_of


@dataclass(frozen=True)
class Plan:
    """What the first rollout settles.

    Args:
        block: the advantage block in native code, where that is worth it.
        keys: entries of a rollout that the loss reads.
        anchors: of these, the ones that keep their value from before the first epoch when the advantage is estimated
            again: what losses measure a change from.
        step: on a minibatch.
        batch: an example.
    """

    block: CompiledAdvantage | None
    keys: Sequence[Any]
    anchors: Sequence[Any]
    step: GradientStep
    batch: TensorDictBase

    @property
    def native(self) -> list[Compiled]:
        """What is compiled."""
        return [*self.step.native, *([self.block.native] if self.block else [])]


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
        accumulate: minibatches whose gradients add up to one optimizer step, weighted by their rows.
        augment: ``batch -> batch`` that changes a minibatch before the loss reads it, inside the compiled step.
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
        accumulate: int = 1,
        augment: Augmentation | None = None,
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
        self.sequence_length, self.accumulate, self.augment = sequence_length, accumulate, augment
        self.epochs, self.minibatch_size, self.max_grad_norm = epochs, minibatch_size, max_grad_norm
        self.recompute_advantage, self.normalize_advantage = recompute_advantage, normalize_advantage
        self.target_kl, self.schedules, self.total_frames = target_kl, dict(schedules or {}), total_frames
        self.compile, self.frames = compile, 0
        self.learners: Alone | Learners = Alone()  # data_parallel changes it
        self.between: Callable[[Grads], Grads] | None = None  # changes the gradients before the optimizer's step
        self.generator = torch.Generator().manual_seed(int(torch.randint(2**62, ())) if seed is None else seed)
        self._plan: Plan | None = None
        check_settings(self._view, vars(self))

    @interruptible
    def __call__(self, rollout: TensorDictBase) -> dict[str, float]:
        """Trains on a rollout ``[num_envs, T]``; metrics are means over the minibatches.

        Time is the last dimension: flattened, an advantage would run from one environment into the next.
        """
        frames = self.learners.begin(rollout)
        self._follow_schedules()
        if self._plan is None:
            self._plan, flat = self._assemble(rollout)
        else:
            flat = self._rows(self._plan, rollout)
        plan, size, device, results = self._plan, self._size(flat), device_of(flat), list[Tensor]()
        epoch, bound, step = 0, None, plan.step
        for epoch in range(1, self.epochs + 1):
            if epoch > 1 and self.recompute_advantage:
                flat = self._rows(plan, rollout).update(flat.select(*plan.anchors))
            batches = list(minibatches(len(flat), size, self.generator, device, self.accumulate))
            rows = self.learners.prepared(flat, batches)
            if rows is not bound:
                bound, step = rows, plan.step.bind(rows, torch.arange(size, device=device))
            start = len(results)
            results += [step(*indices) for indices in batches]
            if self.target_kl is not None and self._kl(plan.step.names, results[start:]) > 1.5 * self.target_kl:
                break
        self.frames += frames
        rate = float(self.optimizer.param_groups[0]["lr"])
        return means(plan.step.names, results) | {"epochs": float(epoch), "learning_rate": rate}

    def __str__(self) -> str:
        size = self.minibatch_size or "the whole rollout"
        norm = f"gradient norm at most {self.max_grad_norm:g}, " if self.max_grad_norm is not None else ""
        step = f"{self.epochs} epochs of minibatches of {size}, {norm}compile {self.compile}"
        return diagram(self, self._view, self.optimizer, step, self._plan and self._plan.batch)

    @property
    def _view(self) -> LossView:
        return LossView(self.loss, self.advantage)

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling so far."""
        return sum(native.seconds for native in self._plan.native) if self._plan else 0.0

    def state_dict(self) -> dict[str, Any]:
        """Networks, coefficients, optimizer, statistics of the advantage block, minibatch order and frame count."""
        return save(self._parts()) | {"generator": self.generator.get_state(), "frames": self.frames}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`; the compiled step is built again at the next call."""
        load(self._parts(), state)
        self.generator.set_state(state["generator"])
        self.frames, self._plan = state["frames"], None

    def _parts(self) -> dict[str, Any]:
        block = self.advantage if isinstance(self.advantage, nn.Module) else None
        return {"loss": self.loss, "advantage": block, "optimizer": self.optimizer}

    def _size(self, flat: TensorDictBase) -> int:
        """Rows of a minibatch, or sequences."""
        return int(min((self.minibatch_size or flat.numel()) // (self.sequence_length or 1), len(flat)))

    def _rows(self, plan: Plan, rollout: TensorDictBase) -> TensorDictBase:
        """The advantage, then the entries that the loss reads as ``[rows, ...]``."""
        rollout = self._view.estimated(rollout, plan.block or self.advantage)
        return as_rows(rollout.select(*plan.keys), self.sequence_length)

    def _assemble(self, rollout: TensorDictBase) -> tuple[Plan, TensorDictBase]:
        """The plan, and the rollout's rows."""
        view, block = self._view, self._compiled_advantage(rollout)
        estimated = view.estimated(rollout, block or self.advantage)
        keys = view.readable(estimated)
        flat = as_rows(estimated.select(*keys), self.sequence_length)
        batch = flat[: self._size(flat)]
        look = partial(assembly, view, self.optimizer, batch, rollout=rollout, resumed=self.frames > 0)
        names = undone(self.loss.buffers(), look)
        anchors = [key for key in (*view.keys("value"), *view.keys("sample_log_prob")) if key in keys]
        step = self._gradient_step(
            names, rollout.numel() * self.learners.size, self.epochs * -(-len(flat) // len(batch))
        )
        return Plan(block, keys, anchors, step, batch), flat

    def _gradient_step(self, names: Sequence[str], frames: int, steps: int) -> GradientStep:
        """One step on a minibatch, of so many steps for so many frames."""
        params, view = parameters(self.optimizer), self._view
        key = view.key("advantage") or "advantage"

        def gradients(data: TensorDictBase, index: Tensor) -> tuple[list[Tensor], Grads]:
            batch = cast(TensorDictBase, data[index])
            if self.augment is not None:
                batch = self.augment(batch)
            if self.normalize_advantage:
                batch = batch.copy().set(key, standardize(batch[key], view.counting(batch, batch[key], key)))
            out = result_of(self.loss, batch)
            grads = grads_of(out, params)
            return metrics_of(out, names, like=grads[0]), grads

        calls = None if self.total_frames is None else self.total_frames / frames * steps
        return GradientStep(
            gradients,
            self.optimizer,
            names,
            watch={"the loss": self.loss, "the augmentation": self.augment},
            max_grad_norm=self.max_grad_norm,
            between=self.between,
            mean=self.learners.mean,
            agree=self.learners.agree,
            apart=self.accumulate > 1,
            mode=choose(self.compile, calls, least_calls=30_000),
        )

    def _compiled_advantage(self, rollout: TensorDictBase) -> CompiledAdvantage | None:
        """The advantage block, compiled where it is a good part of the update: a few steps a rollout."""
        few = self.epochs * rollout.numel() <= 4 * (self.minibatch_size or rollout.numel())
        if not (few and self._view.recordable):
            return None
        rollouts = None if self.total_frames is None else self.total_frames / rollout.numel()
        mode = choose(self.compile, rollouts, least_calls=5_000)
        block = cast(TensorDictModuleBase, self.advantage)
        return None if mode == "off" else CompiledAdvantage(block, mode, self.learners.agree)

    def _follow_schedules(self) -> None:
        for name, schedule in self.schedules.items():
            value = schedule(self.frames / (self.total_frames or 1))
            if name == "lr":
                for group in self.optimizer.param_groups:
                    group["lr"] = value
            else:
                self._view.coefficients()[name].fill_(value)

    def _kl(self, names: Sequence[str], results: Sequence[Tensor]) -> float:
        found = [name for name in ("approx_kl", "kl_approx") if name in names]
        if not found:
            raise UserError(f"target_kl needs a loss that reports approx_kl; {self._view.name} does not")
        return means(names, results)[found[0]]


class CompiledAdvantage:
    """An advantage block in native code."""

    def __init__(self, block: TensorDictModuleBase, mode: Mode, agree: Callable[[bool], bool] = bool) -> None:
        def entries(data: TensorDictBase) -> list[Tensor]:
            out = block(data.copy())
            return [out[key] for key in block.out_keys]

        def others(data: TensorDictBase) -> list[tuple[TensorDictBase]]:
            """The same steps in another order."""
            rolled = [data.apply(lambda x, dim=dim: x.clone().copy_(x.roll(1, dim))) for dim in range(data.batch_dims)]
            return [(cast(TensorDictBase, one),) for one in rolled]

        self.block = block
        self.native = compiled(
            entries, {"the advantage block": block}, others, mode, name="the advantage block", agree=agree, most=300,
            but={"training"},
        )  # fmt: skip

    def __call__(self, rollout: TensorDictBase) -> TensorDictBase:
        for key, x in zip(self.block.out_keys, self.native.bind(rollout)(), strict=True):
            rollout.set(key, x)
        return rollout
