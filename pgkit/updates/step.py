"""One optimizer step: gradients of minibatches, and what they change; one graph, or two with something between."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Optimizer

from pgkit import optim
from pgkit.checks import is_loss
from pgkit.compiled import Mode, compiled
from pgkit.errors import UserError

Gradients = Callable[[TensorDictBase, Tensor], tuple[Tensor, list[Tensor]]]
Grads = list[Tensor]


def grads_of(out: TensorDictBase, params: Sequence[Tensor], only: Container[str] | None = None) -> Grads:
    """Gradients of the sum of a loss's ``loss_*`` entries (of those in ``only``), zero where none depends on it."""
    terms = [key for key in out.keys() if is_loss(key) and (only is None or key in only)]
    total = torch.stack([out[key].sum() for key in terms]).sum()
    return list(torch.autograd.grad(total, params, allow_unused=True, materialize_grads=True))


def metrics_of(out: TensorDictBase, names: Iterable[str], like: Tensor) -> Tensor:
    """The entries of a loss's result that are reported ``[len(names)]``, in the type of ``like``."""
    return torch.stack([out[name].detach().to(like.dtype).mean() for name in names])


class GradientStep:
    """``step(data, index) -> metrics``: gradients, norm clip, optimizer, target networks.

    With an optimizer that has a rule (:func:`pgkit.optim.bound`) all of it is one compiled graph. Gradients that
    are added up over minibatches, or that ``between`` changes, make two, and an optimizer without a rule steps by
    itself.

    Args:
        gradients: ``(data, index) -> (metrics, grads)``: gathers the minibatch, runs the loss; one gradient for each of
            ``params``, as :func:`grads_of` makes them.
        optimizer: its parameters are the ones that are trained.
        names: of the metrics; ``grad_norm`` is added to them.
        params: the optimizer's parameters to step on; None: all.
        watch: modules that ``gradients`` uses, by name, as in :func:`pgkit.compiled.compiled`.
        holds: further tensors that change in place.
        max_grad_norm: bound of the gradient's norm over all parameters; None: no bound.
        after: what follows the optimizer's step: the target networks move.
        between: ``grads -> grads`` before the norm clip.
        mean: ``[metrics, *grads] -> [metrics, *grads]`` before that: the mean over several learners.
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
        after: Callable[[], None] | None = None,
        between: Callable[[Grads], Grads] | None = None,
        mean: Callable[[Sequence[Tensor]], list[Tensor]] | None = None,
        agree: Callable[[bool], bool] = bool,
        apart: bool = False,
        mode: Mode = "off",
    ) -> None:
        if max_grad_norm is not None and max_grad_norm <= 0:
            raise UserError(f"max_grad_norm={max_grad_norm} lets nothing be trained: give a bound above 0, or None")
        self.optimizer, self.names = optimizer, [*names, "grad_norm"]
        self.between, self.mean = between, mean
        self._params = optim.parameters(optimizer) if params is None else list(params)
        self._rules = rules = None if mode == "off" else optim.bound(optimizer, self._params)
        step = partial(optim.step, optimizer, self._params) if rules is None else rules.apply
        self._apart = apart or between is not None or mean is not None or rules is None

        @torch.no_grad()
        def apply(grads: Grads) -> Tensor:
            norm = torch.stack([grad.square().sum() for grad in grads]).sum().sqrt()
            if max_grad_norm is not None:
                factor = optim.computed_once((max_grad_norm / (norm + 1e-6)).clamp(max=1.0))
                grads = [grad * factor for grad in grads]
            step(grads)
            if after is not None:
                after()
            return norm

        def first(data: TensorDictBase, index: Tensor) -> list[Tensor]:
            metrics, grads = gradients(data, index)
            return [metrics, *grads] if self._apart else [torch.cat([metrics, apply(grads)[None]])]

        def second(_: None, *grads: Tensor) -> list[Tensor]:
            return [apply(list(grads))]

        held = [*self._params, *([] if rules is None else rules.tensors), *holds]
        native = partial(compiled, watch=watch, holds=held, agree=agree)
        self.native = (
            native(first, others=other_rows, mode=mode, name="the update"),
            native(second, others=_other_gradients, mode="off" if rules is None else mode, name="the optimizer's step"),
        )

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
        first, size = self.native[0], len(index)
        call = first.bind(data, index)

        def run(index: Tensor) -> Sequence[Tensor]:
            return call(index) if len(index) == size else first.function(data, index)

        return self._in_two(run) if self._apart else lambda index: run(index)[0]

    def _in_two(self, run: Callable[[Tensor], Sequence[Tensor]]) -> Callable[..., Tensor]:
        def call(*indices: Tensor) -> Tensor:
            rows = sum(map(len, indices))
            results = _sum(map(run, indices), [len(index) / rows for index in indices])
            metrics, *grads = results if self.mean is None else self.mean(results)
            grads = grads if self.between is None else self.between(grads)
            (norm,) = self.native[1].bind(None, *grads)(*grads)
            return torch.cat([metrics, norm[None]])

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


def _other_gradients(_: None, *grads: Tensor) -> list[tuple[Any, ...]]:
    return [(None, *(scale * grad for grad in grads)) for scale in (0.5, -3.0)]
