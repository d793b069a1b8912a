"""One optimizer step: gradients of minibatches, and what they change; one graph, or two with something between."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from functools import partial, reduce
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Optimizer

from pgkit import optim
from pgkit.checks import is_loss
from pgkit.compiled import Mode, compiled, tensors_of, undone, written_by
from pgkit.errors import UserError

Grads = list[Tensor]
Gradients = Callable[[TensorDictBase, Tensor], tuple[list[Tensor], Grads]]


def grads_of(out: TensorDictBase, params: Sequence[Tensor], only: Container[str] | None = None) -> Grads:
    """Gradients of the sum of a loss's ``loss_*`` entries (of those in ``only``), zero where none depends on it."""
    terms = [key for key in out.keys() if is_loss(key) and (only is None or key in only)]
    total = torch.stack([out[key].sum() for key in terms]).sum()
    return list(torch.autograd.grad(total, params, allow_unused=True, materialize_grads=True))


def metrics_of(out: TensorDictBase, names: Iterable[str], like: Tensor) -> list[Tensor]:
    """The entries of a loss's result that are reported, one number each, in the type of ``like``."""
    return [out[name].detach().to(like.dtype).mean() for name in names]


def norm_of(grads: Grads) -> Tensor:
    """The norm of the gradient over all parameters."""
    return reduce(torch.add, [grad.square().sum() for grad in grads]).sqrt()  # no stack: that is a tensor for each


class GradientStep:
    """``step(data, index) -> metrics``: gradients, norm clip, optimizer, target networks.

    With an optimizer that has a rule (:func:`pgkit.optim.bound`) all of it is one compiled graph. Gradients that
    are added up over minibatches, or that ``between`` changes, make two, and an optimizer without a rule steps by
    itself.

    A step whose gradient is not finite changes nothing: not the parameters, the optimizer's state and the targets, nor
    what the loss keeps in buffers. The metric ``skipped`` is 1 for such a step, 0 for every other.

    Args:
        gradients: ``(data, index) -> (metrics, grads)``: gathers the minibatch, runs the loss; one gradient for each of
            ``params``, as :func:`grads_of` makes them.
        optimizer: its parameters are the ones that are trained.
        names: of the metrics; ``grad_norm`` and ``skipped`` are added to them.
        params: the optimizer's parameters to step on; None: all.
        watch: modules that ``gradients`` uses, by name, as in :func:`pgkit.compiled.compiled`.
        holds: further tensors that change in place.
        max_grad_norm: bound of the gradient's norm over all parameters; None: no bound.
        after: what follows the optimizer's step: weights are projected, target networks move. It is given a 0-dim bool;
            where that is False, nothing may change.
        between: ``grads -> grads`` before the norm clip.
        mean: ``[*metrics, *grads] -> [*metrics, *grads]`` before that: the mean over several learners.
        agree: as in :func:`pgkit.compiled.compiled`.
        apart: keeps the two graphs apart, for a call on several minibatches.
        mode: as in :func:`pgkit.compiled.compiled`.

    Attributes:
        native: the compiled functions, with their ``seconds`` and ``rung``: the whole, or gradients and optimizer.
    """

    def __init__(
        self,
        gradients: Gradients,
        optimizer: Optimizer,
        names: Sequence[str],
        *,
        params: Sequence[Tensor] | None = None,
        watch: Mapping[str, Any],
        holds: Iterable[Tensor] = (),
        max_grad_norm: float | None = None,
        after: Callable[[Tensor], None] | None = None,
        between: Callable[[Grads], Grads] | None = None,
        mean: Callable[[Sequence[Tensor]], list[Tensor]] | None = None,
        agree: Callable[[bool], bool] = bool,
        apart: bool = False,
        mode: Mode = "off",
    ) -> None:
        if max_grad_norm is not None and max_grad_norm <= 0:
            raise UserError(f"max_grad_norm={max_grad_norm} lets nothing be trained: give a bound above 0, or None")
        self.optimizer, self.names = optimizer, [*names, "grad_norm", "skipped"]
        self.between, self.mean = between, mean
        self._params = optim.parameters(optimizer) if params is None else list(params)
        self._gradients, self._watch, self._holds = gradients, watch, list(holds)
        self._max_grad_norm, self._after = max_grad_norm, after
        self._rules = rules = None if mode == "off" else optim.bound(optimizer, self._params)
        self._apart = apart or between is not None or mean is not None or rules is None
        self._statistics: list[Tensor] | None = None  # buffers that the loss writes to as it runs
        held = [*self._params, *([] if rules is None else rules.tensors), *self._holds]
        native = partial(compiled, watch=watch, holds=held, agree=agree)
        self.native = (
            native(self._first, others=other_rows, mode=mode, name="the update"),
            native(self._second, others=_other_gradients, mode=mode if rules else "off", name="the optimizer's step"),
        )

    def _first(self, data: TensorDictBase, index: Tensor) -> list[Tensor]:
        """The whole step, or metrics and gradients of a minibatch."""
        before = [] if self._apart else self._copies()
        metrics, grads = self._gradients(data, index)
        return [*metrics, *grads] if self._apart else [torch.stack([*metrics, *self._apply(grads, before)])]

    def _second(self, _: None, *tensors: Tensor) -> list[Tensor]:
        """The step with gradients, from statistics before them."""
        grads = list(tensors[: len(self._params)])
        return [*self._apply(grads, tensors[len(grads) :])]

    @torch.no_grad()
    def _apply(self, grads: Grads, before: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Steps on the gradients, if they are finite; their norm, and 1 if they are not."""
        norm = norm_of(grads)
        finite = optim.computed_once(norm.isfinite())
        if self._max_grad_norm is not None:
            factor = optim.computed_once((self._max_grad_norm / (norm + 1e-6)).clamp(max=1.0))
            grads = [grad * factor for grad in grads]
        if self._rules is not None:
            self._rules.apply(grads, finite)
        elif finite:
            optim.step(self.optimizer, self._params, grads)
        for x, old in zip(self._statistics or (), before, strict=True):
            x.copy_(torch.where(finite, x, old))
        if self._after is not None:
            self._after(finite)
        return norm, (~finite).to(norm.dtype)

    def _copies(self) -> list[Tensor]:
        return [x.clone() for x in self._statistics or ()]

    def __call__(self, data: TensorDictBase, index: Tensor) -> Tensor:
        """One step on the rows ``index`` of ``data``; metrics ``[len(names)]``, still on the device."""
        return self.bind(data, index)(index)

    def bind(self, data: TensorDictBase, index: Tensor) -> Callable[..., Tensor]:
        """``call(*indices) -> metrics`` on ``data``, for a series of steps; several indices add up to one step.

        Learning rates are read off the optimizer, and what was replaced in the loss is noticed. The code is for indices
        of the size of ``index``; others run as they are.

        Raises:
            UserError: a parameter of the optimizer was frozen, or a setting of it other than ``lr`` was changed.
        """
        if not all(p.requires_grad for p in self._params):
            raise UserError(
                "a parameter of the optimizer was frozen after the first step (requires_grad is False): what is "
                "trained is decided when an update is built, build a new one with an optimizer of the others"
            )
        if self._rules is not None:
            self._rules.read()
        if self._statistics is None:
            trial = partial(written_by, tensors_of(self._watch), partial(self._gradients, data, index))
            self._statistics = undone(self._holds, trial)
        first, size = self.native[0], len(index)
        call = first.bind(data, index)

        def run(index: Tensor) -> Sequence[Tensor]:
            return call(index) if len(index) == size else first.function(data, index)

        return self._in_two(run) if self._apart else lambda index: run(index)[0]

    def _in_two(self, run: Callable[[Tensor], Sequence[Tensor]]) -> Callable[..., Tensor]:
        def call(*indices: Tensor) -> Tensor:
            rows, before = sum(map(len, indices)), self._copies()
            results = _sum(map(run, indices), [len(index) / rows for index in indices])
            results = results if self.mean is None else self.mean(results)
            metrics, grads = results[: -len(self._params)], results[-len(self._params) :]
            grads = grads if self.between is None else self.between(grads)
            return torch.stack([*metrics, *self.native[1].bind(None, *grads, *before)(*grads, *before)])

        return call


def _sum(results: Iterable[Sequence[Tensor]], shares: Sequence[float]) -> list[Tensor]:
    """The weighted sum of the results, one in memory at a time; of a single one itself."""
    total: list[Tensor] = []
    for share, result in zip(shares, results, strict=True):
        scaled = list(result) if len(shares) == 1 else [share * x for x in result]
        total = [x.add_(more) for x, more in zip(total, scaled, strict=True)] if total else scaled
    return total


def other_rows(data: TensorDictBase, index: Tensor) -> Iterator[tuple[TensorDictBase, Tensor]]:
    """Other rows of the data, as many, on which a compiled step must repeat the step."""
    for shift in range(1, 9):
        other = (index + shift * (len(index) + 1)) % (index.max() + 1)
        # data that is the batch may be used without the index: it gets other rows as well, some of them repeated
        rows = other // (1 + shift)
        batch = data.batch_size == index.shape
        yield cast(TensorDictBase, data.apply(lambda x, rows=rows: x.clone().copy_(x[rows]))) if batch else data, other


def _other_gradients(_: None, *tensors: Tensor) -> list[tuple[Any, ...]]:
    scales = (0.5, -3.0, torch.inf)
    return [(None, *((scale * x).to(x.dtype) for x in tensors)) for scale in scales]
