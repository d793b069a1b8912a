"""Random numbers for a policy that do not depend on which rows stand beside a row: a stream of its own for each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from pgkit.compiled import Instead

Kind = Literal["normal", "uniform", "exponential"]
Function = Callable[..., tuple[Tensor, ...]]
_GOLDEN, _FIRST, _SECOND = (x - 2**64 for x in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
_STRIDE = 1 << 24  # numbers that a row may draw in one step
_AHEAD, _MOST = 64, 1 << 20  # steps, and numbers, that are made at once for short rollouts


class Draw(NamedTuple):
    """One random tensor of a policy's step; its first dimension is the rows, or a multiple of them."""

    kind: Kind
    shape: torch.Size
    dtype: torch.dtype


class Unsupported(RuntimeError):
    """A policy draws in a way that has no place here."""


class Streams:
    r"""Noise ``[steps, *shape]`` for the draws of ``rows`` environments, a function of seed, environment and step.

    Number :math:`j` of environment :math:`i` is :math:`\mathrm{mix}(k_i + j \cdot g)`, SplitMix64 (Steele et al., 2014,
    https://doi.org/10.1145/2660193.2660195) with a key :math:`k_i` hashed from ``(seed, i)``. Nothing is
    carried from one to the next, so every process, device and resumed run makes the same ones.
    """

    def __init__(self, draws: Sequence[Draw], seed: int, first: int, rows: int, device: torch.device) -> None:
        self.draws, self.rows = draws, rows
        words = [np.random.SeedSequence((seed, i)).generate_state(1, np.uint64) for i in range(first, first + rows)]
        self._keys = torch.from_numpy(np.concatenate(words).view(np.int64)).to(device).view(1, rows, 1)
        self._begin, self._made = 0, list[tuple[Tensor, ...]]()
        self._size = sum(draw.shape.numel() for draw in draws)

    def at(self, step: int, steps: int) -> list[tuple[Tensor, ...]]:
        """For each of the steps from ``step`` on, the tensors that the draws ask for."""
        if not self.draws:
            return [()] * steps
        if step < self._begin or step + steps > self._begin + len(self._made):
            count = max(steps, min(_AHEAD, _MOST // self._size))
            drawn = [x.unbind(0) for x in self.make(step, count)]
            self._begin, self._made = step, list(zip(*drawn, strict=True))
        return self._made[step - self._begin : step - self._begin + steps]

    def make(self, step: int, steps: int) -> list[Tensor]:
        """The noise of each draw for ``steps`` steps from ``step`` on."""
        out, offset, device = [], 0, self._keys.device
        times = torch.arange(step, step + steps, device=device).view(-1, 1, 1) * _STRIDE
        for draw in self.draws:
            each = draw.shape.numel() // self.rows
            numbers = times + torch.arange(offset, offset + each, device=device)
            bits = _mix(self._keys + numbers * _GOLDEN)
            out.append(_shaped(bits, draw).view(steps, *draw.shape))
            offset += each
        return out


def _mix(x: Tensor) -> Tensor:
    for shift, factor in ((30, _FIRST), (27, _SECOND)):
        x = (x ^ _right(x, shift)) * factor
    return x ^ _right(x, 31)


def _right(x: Tensor, shift: int) -> Tensor:
    """The logical shift, of numbers that torch takes to be signed."""
    return (x >> shift) & ((1 << (64 - shift)) - 1)


def _shaped(bits: Tensor, draw: Draw) -> Tensor:
    """Numbers of the distribution asked for from 64 random bits each."""
    double = draw.dtype is torch.float64
    used, dtype = (32, torch.float64) if double else (23, torch.float32)
    unit = (_right(bits, 64 - used).to(dtype) + 0.5) * 2.0**-used  # in (0, 1), and exact
    if draw.kind == "exponential":
        unit = -unit.log()
    elif draw.kind == "normal":  # Box and Muller (1958)
        angle = (bits & ((1 << used) - 1)).to(dtype) * (2 * math.pi * 2.0**-used)
        unit = (-2 * unit.log()).sqrt() * angle.cos()
    return unit.to(draw.dtype)


def census(function: Function, inputs: Sequence[Tensor], rows: int) -> list[Draw] | None:
    """What a function of tensors ``[rows, ...]`` draws; None where a draw has no rows or its kind is unknown."""
    draws: list[Draw] = []

    def give(kind: Kind, shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
        draw = Draw(kind, torch.Size(shape), dtype)
        if not draw.shape or draw.shape[0] % rows or draw.shape.numel() // rows >= _STRIDE:
            raise Unsupported
        draws.append(draw)
        return torch.full(draw.shape, 0.5, dtype=dtype, device=device)

    try:
        with _drawing(give):
            function(*inputs)
    except Unsupported:
        return None
    return draws


def fed(function: Function, inputs: int) -> Function:
    """The function with its random numbers as further arguments, in the order of :func:`census`."""

    def act(*given: Tensor) -> tuple[Tensor, ...]:
        noise = list(given[inputs:])

        def give(kind: Kind, shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
            if not noise or noise[0].shape != torch.Size(shape) or noise[0].dtype != dtype:
                raise RuntimeError("the policy draws other random numbers than in its first step")
            return noise.pop(0)

        with _drawing(give):
            return function(*given[:inputs])

    return act


Give = Callable[[Kind, Sequence[int], torch.dtype, torch.device], Tensor]


def _drawing(give: Give) -> Instead:
    """Within it, every random operation of torch takes its numbers from ``give``."""

    def draw(operation: Any, *args: Any, **kwargs: Any) -> Any:
        if torch.Tag.nondeterministic_seeded not in operation.tags:
            return operation(*args, **kwargs)
        rule = _RULES.get(operation.overloadpacket)
        if rule is None:
            raise Unsupported(f"{operation}")
        settings = {key: x for key, x in kwargs.items() if key in ("dtype", "device") and x is not None}
        return rule(_Source(give, settings), *args)

    return Instead(draw)


class _Source:
    """Draws for one operation; ``settings`` are the dtype and device that it was called with."""

    def __init__(self, give: Give, settings: dict[str, Any]) -> None:
        self.give, self.settings = give, settings

    def like(self, kind: Kind, x: Tensor) -> Tensor:
        dtype, device = self.settings.get("dtype", x.dtype), self.settings.get("device", x.device)
        return self.give(kind, x.shape, dtype, device)

    def new(self, kind: Kind, shape: Sequence[int]) -> Tensor:
        dtype = self.settings.get("dtype", torch.get_default_dtype())
        return self.give(kind, shape, dtype, self.settings.get("device", torch.device("cpu")))

    def integers(self, low: int, high: int, shape: Sequence[int]) -> Tensor:
        device = self.settings.get("device", torch.device("cpu"))
        unit = self.give("uniform", shape, torch.float64, device)
        return (low + (unit * (high - low)).floor()).to(self.settings.get("dtype", torch.int64))


def _scaled(x: Tensor, shift: Any, scale: Any) -> Tensor:
    """``shift + scale * x``, without operations that change nothing."""
    x = x if isinstance(scale, int | float) and scale == 1 else scale * x
    return x if isinstance(shift, int | float) and shift == 0 else shift + x


def _normal(source: _Source, mean: Any, std: Any = 1.0, *shape: Any) -> Tensor:
    if shape:
        return _scaled(source.new("normal", shape[0]), mean, std)
    return _scaled(source.like("normal", mean if isinstance(mean, Tensor) else std), mean, std)


def _multinomial(source: _Source, weights: Tensor, samples: int, replacement: bool = False) -> Tensor:
    if samples != 1:
        raise Unsupported
    return (weights / source.like("exponential", weights)).argmax(-1, keepdim=True)


def _bernoulli_(source: _Source, x: Tensor, p: Any = 0.5) -> Tensor:
    unit = source.give("uniform", x.shape, torch.float32, x.device)
    return x.copy_(unit < p)


def _randint(source: _Source, *args: Any) -> Tensor:
    low, high, shape = args if len(args) == 3 else (0, *args)
    return source.integers(low, high, shape)


def _random_(source: _Source, x: Tensor, *bounds: int) -> Tensor:
    if not bounds:
        raise Unsupported
    low, high = bounds if len(bounds) == 2 else (0, *bounds)
    return x.copy_(_Source(source.give, {"device": x.device}).integers(low, high, x.shape))


_ATEN = torch.ops.aten
_RULES: dict[Any, Callable[..., Any]] = {
    _ATEN.randn: lambda source, shape: source.new("normal", shape),
    _ATEN.randn_like: lambda source, x: source.like("normal", x),
    _ATEN.normal: _normal,
    _ATEN.normal_: lambda source, x, mean=0.0, std=1.0: x.copy_(_scaled(source.like("normal", x), mean, std)),
    _ATEN.rand: lambda source, shape: source.new("uniform", shape),
    _ATEN.rand_like: lambda source, x: source.like("uniform", x),
    _ATEN.uniform_: lambda source, x, low=0.0, high=1.0: x.copy_(_scaled(source.like("uniform", x), low, high - low)),
    _ATEN.exponential_: lambda source, x, rate=1.0: x.copy_(_scaled(source.like("exponential", x), 0, 1 / rate)),
    _ATEN.multinomial: _multinomial,
    _ATEN.bernoulli: lambda source, x, p=None: (source.like("uniform", x) < (x if p is None else p)).to(x.dtype),
    _ATEN.bernoulli_: _bernoulli_,
    _ATEN.randint: _randint,
    _ATEN.random_: _random_,
}
