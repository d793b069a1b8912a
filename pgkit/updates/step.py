"""One gradient step as one graph: minibatch, loss, gradient, norm clip, optimizer."""

from __future__ import annotations

import time
import types
import warnings
from collections.abc import Callable, Mapping, Sequence
from logging import getLogger
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Optimizer

from pgkit import optim
from pgkit.checks import is_loss
from pgkit.constants import Constants
from pgkit.errors import UserError
from pgkit.updates.recorded import Step, recorded


def _rows(data: TensorDictBase, index: Tensor) -> TensorDictBase:
    return cast(TensorDictBase, data[index])


class GradientStep:
    """``step(data, index) -> metrics``: one optimizer step on the sum of the ``loss_*`` entries at ``data[index]``.

    Compiled, all of it is one graph: the gather, the loss, ``autograd.grad``, the norm clip, the optimizer's own
    function on the optimizer's own state, and ``after``. There are two ways to the graph. The step is recorded as
    tensor operations and compiled for exactly these tensors, without dynamo at run time
    (:mod:`~pgkit.updates.recorded`). Where it cannot be recorded, it is one
    ``torch.compile(fullgraph=True)`` graph; once a pair of shapes has been seen, calls skip dynamo's guards. An
    optimizer without a functional form steps outside the graph.

    Args:
        loss: TorchRL ``LossModule`` or any module from TensorDict to TensorDict with ``loss_*`` entries.
        optimizer: its parameters are the ones that are trained.
        names: entries of the loss's result to report, in this order; ``grad_norm`` is added to them.
        max_grad_norm: bound of the gradient's norm over all parameters; None: no bound.
        before: applied to the minibatch first.
        after: called last, without gradients (target networks).
        gather: ``(data, index) -> minibatch``; by default ``data[index]``.
        write_back: called with ``(data, index, minibatch)`` after the loss, without gradients (priorities).
        only: the ``loss_*`` entries to step on and the parameters each trains; the others stay. None: all.
        compile: compile the step.
        written: what ``write_back`` changes, besides ``data``.
        may_fall_back: a step that cannot be compiled runs as it is, with a warning, in place of raising.
    """

    def __init__(
        self,
        loss: nn.Module,
        optimizer: Optimizer,
        names: Sequence[str],
        *,
        max_grad_norm: float | None = None,
        before: Callable[[TensorDictBase], TensorDictBase] | None = None,
        after: Callable[[], None] | None = None,
        gather: Callable[[TensorDictBase, Tensor], TensorDictBase] = _rows,
        write_back: Callable[[TensorDictBase, Tensor, TensorDictBase], None] | None = None,
        only: Mapping[str, Sequence[Tensor]] | None = None,
        compile: bool = False,
        written: Sequence[Tensor] = (),
        may_fall_back: bool = False,
    ) -> None:
        if max_grad_norm is not None and max_grad_norm <= 0:
            raise UserError(f"max_grad_norm={max_grad_norm} lets nothing be trained: give a bound above 0, or None")
        self.optimizer, self.loss = optimizer, loss
        self.names = [*names, "grad_norm"]
        self.compile_seconds = 0.0
        self._runs: dict[Any, Step] = {}
        self._constants: Constants | None = None
        params = optim.parameters(optimizer)
        if only is not None:
            kept = {id(p) for reached in only.values() for p in reached}
            params = [p for p in params if id(p) in kept]
        self._rules = rules = optim.bound(optimizer, params) if compile else None

        def step(data: TensorDictBase, index: Tensor) -> tuple[Tensor, list[Tensor]]:
            batch = gather(data, index)
            batch = batch if before is None else before(batch)
            out = loss(batch)
            terms = [key for key in out.keys() if is_loss(key) and (only is None or key in only)]
            total = torch.stack([out[key].sum() for key in terms]).sum()
            grads = list(torch.autograd.grad(total, params, allow_unused=True, materialize_grads=True))
            with torch.no_grad():
                if write_back is not None:
                    write_back(data, index, batch)
                norm = torch.stack([grad.square().sum() for grad in grads]).sum().sqrt()
                if max_grad_norm is not None:
                    factor = optim.computed_once((max_grad_norm / (norm + 1e-6)).clamp(max=1.0))
                    grads = [grad * factor for grad in grads]
                if rules is not None:
                    rules.apply(grads)
                    if after is not None:
                        after()
                metrics = torch.stack([*(out[name].detach().to(norm.dtype).mean() for name in names), norm])
            return metrics, [] if rules is not None else grads

        # dynamo caches by code object: one of its own keeps each agent's graph apart from every other agent's
        code = step.__code__.replace(co_name=f"step_{id(self)}")
        step = types.FunctionType(code, step.__globals__, step.__name__, None, step.__closure__)
        self._eager, self._after, self._params = step, after, params
        self._compile, self._written, self._may_fall_back = compile, written, may_fall_back

    def begin(self) -> None:
        """Reads the learning rates off the optimizer, and looks for what was replaced in the loss.

        Call it before a series of steps.

        Raises:
            UserError: a parameter of the optimizer was frozen, or a setting of it other than ``lr`` was changed.
        """
        if not all(p.requires_grad for p in self._params):
            raise UserError(
                "a parameter of the optimizer was frozen after the first step (requires_grad is False): what is "
                "trained is decided when an update is built, build a new one with an optimizer of the others"
            )
        changed = None if self._constants is None else self._constants.changed()
        if changed:
            getLogger("pgkit").warning(
                "the update is compiled again: in the loss %s (what changes in place, by fill_, needs no such thing)",
                changed,
            )
            self._runs, self._constants = {}, None
        if self._rules is not None:
            self._rules.read()

    def __call__(self, data: TensorDictBase, index: Tensor) -> Tensor:
        """One step on the rows ``index`` of ``data``; metrics ``[len(names)]``, still on the device."""
        if not self._compile:
            return self.eager(data, index)
        signature = (index.shape, data.batch_size)
        if signature in self._runs:
            metrics, grads = self._runs[signature](data, index)
        else:
            start = time.perf_counter()
            if not self._runs:
                getLogger("pgkit").info("compiling the update, once: up to 40 seconds, less when it is in the cache")
            self._constants = constants = Constants(self.loss)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the compiler's, on tensordict's and TorchRL's code
                self._runs[signature], (metrics, grads) = self._build(data, index)
            if self._runs[signature] is not self._eager and (changed := constants.changed()):
                reason = f"the loss changes a number of its own as it runs, which is no part of a graph: {changed}"
                self._fall_back(reason, UserError(f"{reason}; hold it as a tensor, or compile='off'"))
                self._runs[signature], self._constants = self._eager, None
            self.compile_seconds += time.perf_counter() - start
        if self._rules is None:
            self._optimizer_step(grads)
        return metrics

    def eager(self, data: TensorDictBase, index: Tensor) -> Tensor:
        """The same step outside the graph, for a minibatch of another size."""
        metrics, grads = self._eager(data, index)
        if self._rules is None:
            self._optimizer_step(grads)
        return metrics

    def _optimizer_step(self, grads: list[Tensor]) -> None:
        optim.step(self.optimizer, self._params, grads)
        if self._after is not None:
            with torch.no_grad():
                self._after()

    def _build(self, data: TensorDictBase, index: Tensor) -> tuple[Step, tuple[Tensor, list[Tensor]]]:
        """The compiled step for these shapes, and the result of its first call."""
        states = [] if self._rules is None else self._rules.tensors
        held = [*self._params, *states, *self.loss.parameters(), *self.loss.buffers(), *self._written]
        try:
            run = recorded(self._eager, list({id(x): x for x in held}.values()), data, index)
            return run, run(data, index)
        except RuntimeError as error:
            getLogger("pgkit").debug("the step cannot be recorded (%s): torch.compile", error)
        # fallback_random: the same random numbers as eager code
        compiled = torch.compile(self._eager, fullgraph=True, dynamic=False, options={"fallback_random": True})

        def run_compiled(data: TensorDictBase, index: Tensor) -> tuple[Tensor, list[Tensor]]:
            with torch.compiler.set_stance("default", skip_guard_eval_unsafe=True):
                return compiled(data, index)

        try:
            with torch._dynamo.config.patch(trace_autograd_ops=True):
                return run_compiled, compiled(data, index)
        except torch._dynamo.exc.TorchDynamoException as error:
            self._fall_back(str(error).strip().splitlines()[0], error)
            return self._eager, self._eager(data, index)

    def _fall_back(self, reason: str, error: Exception) -> None:
        """Says why the step runs as it is from now on, or raises ``error`` where it may not."""
        if not self._may_fall_back:
            raise error
        getLogger("pgkit").warning(
            "the update cannot be compiled and runs without, several times slower (%s); compile='on' shows the "
            "whole reason, compile='off' is silent",
            reason,
        )
