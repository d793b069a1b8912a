"""A step on a CUDA device as one captured CUDA graph: launched once, whatever number of kernels it has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from pgkit.compiled.trial import undone

Run = Callable[..., Sequence[Tensor]]


def captured(
    run: Run, leaves_of: Callable[[Any], list[Tensor]], held: Sequence[Tensor], inputs: Sequence[Tensor]
) -> Callable[[Any], Run]:
    """``bind(data) -> call`` whose calls copy their inputs, replay ``run(*leaves, *inputs)`` and copy the results out.

    A CUDA graph reads fixed memory. Data that is bound again in the memory that it had (a replay) is read there; as
    soon as other memory is bound (rollouts), the graph gets memory of its own, into which every ``bind`` copies.

    Args:
        run: writes to ``held`` and to its arguments in place, and reads no value back.
        leaves_of: the tensors of some data.
        held: what ``run`` changes: the warm-up is undone.
        inputs: an example.
    """
    given = [_copy(x) for x in inputs]
    place: list[Tensor] = []
    replay: Any = None
    copies = False

    def bind(data: Any) -> Run:
        nonlocal place, replay, copies
        leaves = leaves_of(data)
        moved = [x.data_ptr() for x in leaves] != [x.data_ptr() for x in place]
        if moved and replay is not None and copies:
            _fill([_memory(x) for x in place], leaves)
        elif moved or replay is None:
            copies = replay is not None
            place = [_copy(x) for x in leaves] if copies else leaves
            replay = _capture(run, place, held, given)
        return replay

    return bind


def _capture(run: Run, leaves: Sequence[Tensor], held: Sequence[Tensor], given: Sequence[Tensor]) -> Run:
    with torch.cuda.device([*held, *leaves, *given][0].device):  # whose streams these are
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            undone([*held, *leaves], lambda: [run(*leaves, *given) for _ in range(2)])
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # other threads may use the device meanwhile
            results = run(*leaves, *given)

    places = [_memory(x) for x in given]

    def replay(*inputs: Tensor) -> list[Tensor]:
        _fill(places, inputs)
        graph.replay()
        return [x.clone() for x in results]  # the next replay writes to the same memory

    return replay


def _copy(x: Tensor) -> Tensor:
    """A copy with the strides of ``x``, which the code was made for: ``clone`` closes gaps."""
    return _memory(x).clone().as_strided(x.shape, x.stride())


def _memory(x: Tensor) -> Tensor:
    """The memory from the first element to the last one, gaps included, as a vector."""
    last = sum((size - 1) * stride for size, stride in zip(x.shape, x.stride(), strict=True))
    return x.as_strided((last + 1 if x.numel() else 0,), (1,))


def _fill(places: Sequence[Tensor], given: Sequence[Tensor]) -> None:
    """Copies tensors into the memory of others of the same strides."""
    for place, x in zip(places, given, strict=True):
        place.copy_(x.as_strided(place.shape, (1,)))
