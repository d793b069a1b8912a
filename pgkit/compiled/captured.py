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
    given = [x.clone() for x in inputs]
    place: list[Tensor] = []
    replay: Any = None
    copies = False

    def bind(data: Any) -> Run:
        nonlocal place, replay, copies
        leaves = leaves_of(data)
        moved = [x.data_ptr() for x in leaves] != [x.data_ptr() for x in place]
        if moved and replay is not None and copies:
            for mine, its in zip(place, leaves, strict=True):
                mine.copy_(its)
        elif moved or replay is None:
            copies = replay is not None
            place = [x.clone() for x in leaves] if copies else leaves
            replay = _capture(run, place, held, given)
        return replay

    return bind


def _capture(run: Run, leaves: Sequence[Tensor], held: Sequence[Tensor], given: Sequence[Tensor]) -> Run:
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        undone([*held, *leaves], lambda: [run(*leaves, *given) for _ in range(2)])
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        results = run(*leaves, *given)

    def replay(*inputs: Tensor) -> list[Tensor]:
        for mine, its in zip(given, inputs, strict=True):
            mine.copy_(its)
        graph.replay()
        return [x.clone() for x in results]  # the next replay writes to the same memory

    return replay
