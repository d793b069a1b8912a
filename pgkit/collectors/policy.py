"""A TensorDict actor as a plain function of tensors, for the inner stepping loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from logging import getLogger
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torchrl.data import Composite, MultiCategorical, TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit.collectors.actor import acting, is_state, output_keys
from pgkit.collectors.noise import Streams, census, fed
from pgkit.compiled import Compiled, Mode, compiled, undone
from pgkit.envs.seeding import episode_seed
from pgkit.seams import Entries, Key

Act = Callable[..., Sequence[Tensor]]
LEAST_ROWS, LEAST_IMAGES = 16, 4  # matrix products, and convolutions, of fewer rows round differently


def function_of(actor: TensorDictModuleBase, keys: Sequence[Key]) -> Act:
    """The actor, exploring, as a function from tensors at ``keys`` to those at :func:`output_keys`."""
    outputs = output_keys(actor)

    def act(*inputs: Tensor) -> tuple[Tensor, ...]:
        data = TensorDict(dict(zip(keys, inputs, strict=True)), batch_size=inputs[0].shape[:1])
        with acting(actor), set_exploration_type(ExplorationType.RANDOM):
            out = actor(data)
        return tuple(out[key] for key in outputs)

    return act


def random_actions(spec: Composite, keys: Sequence[Key], outputs: Entries) -> Act:
    """A policy that draws actions uniformly from ``spec``, of those that an ``action_mask`` allows.

    Its other outputs, shaped as ``outputs``, are NaN; whole numbers and a recurrent state are zero.
    """
    rows = spec.shape[0]
    masks = {key: (*key[:-1], "action_mask") if isinstance(key, tuple) else "action_mask" for key in outputs}

    def act(*inputs: Tensor) -> tuple[Tensor, ...]:
        given = dict(zip(keys, inputs, strict=True))
        made = []
        for key, x in outputs.items():
            if key not in spec.keys(True, True):
                unknown = torch.nan if x.dtype.is_floating_point and not is_state(key) else 0
                made.append(torch.full_like(x[:rows], unknown))
            elif masks[key] in given:
                made.append(_allowed(spec[key], given[masks[key]].bool()))
            else:
                made.append(spec[key].rand())
        return tuple(made)

    return act


def _allowed(spec: TensorSpec, mask: Tensor) -> Tensor:
    """Discrete actions drawn uniformly of those that a mask ``[N, choices]`` allows."""
    parts = []
    for part in choices(spec, mask):
        possible = part | ~part.any(-1, keepdim=True)  # rows of padding allow nothing, and are thrown away
        drawn = torch.multinomial(possible.flatten(0, -2).float(), 1)
        parts.append(drawn.view(*possible.shape[:-1], 1))
    return torch.cat(parts, -1) if isinstance(spec, MultiCategorical) else parts[0].squeeze(-1)


def choices(spec: TensorSpec, mask: Tensor) -> Sequence[Tensor]:
    """The parts of an action mask ``[*B, n]`` that belong to one choice each."""
    if not isinstance(spec, MultiCategorical):
        return [mask]
    return mask.split(spec.nvec.reshape(-1, spec.shape[-1])[0].tolist(), -1)


def padded_rows(inputs: Sequence[Tensor], num_envs: int) -> int:
    """Rows that a policy is evaluated on for inputs ``[rows, ...]`` of some of ``num_envs`` environments."""
    return max(len(inputs[0]), min(_least_rows(inputs), num_envs))


def _least_rows(inputs: Sequence[Tensor]) -> int:
    return LEAST_IMAGES if any(x.dtype is torch.uint8 and x.dim() > 2 for x in inputs) else LEAST_ROWS


class RowPolicy:
    """A policy for ``rows`` environments of a larger vector, whose results are those it has for all of them at once.

    Random numbers come from a stream for each environment (:class:`~pgkit.collectors.noise.Streams`), and fewer rows
    than sixteen (of images: four) are padded, so that neither depends on which environments this process has. Where
    the policy's random numbers cannot be replaced, torch's generator is seeded for each rollout and share, and the
    log says so.

    Args:
        act: function of tensors ``[rows, ...]``.
        inputs: examples of those.
        num_envs: number of environments of the larger vector.
        first: index of this object's first one.
        seed: the environments' seed.
        actor: what ``act`` calls, to be recorded; None: call ``act`` as it is.
        mode: of :func:`trace`.
    """

    def __init__(
        self,
        act: Act,
        inputs: Sequence[Tensor],
        num_envs: int,
        first: int,
        seed: int,
        actor: TensorDictModuleBase | None = None,
        mode: Mode = "off",
    ) -> None:
        self._seed, self._first, rows = seed, first, len(inputs[0])
        all_rows = padded_rows(inputs, num_envs)
        before = min(first % _least_rows(inputs), all_rows - rows)  # the place of a row matters, too
        self._own = slice(before, before + rows)
        self._padded = [x.new_zeros(all_rows, *x.shape[1:]) for x in inputs] if all_rows > rows else None
        inputs = self._padded or [x.clone() for x in inputs]
        with torch.no_grad(), torch.random.fork_rng():
            draws = census(act, inputs, all_rows)
            device = inputs[0].device
            self._streams = None if draws is None else Streams(draws, seed, first - before, all_rows, device)
            if self._streams is None:
                getLogger("pgkit").info(
                    "the policy draws random numbers in a way that cannot be split by environment: the numbers of a "
                    "run depend on the number of workers"
                )
            elif draws:
                act = fed(act, len(inputs))
                inputs = [*inputs, *self._streams.at(0, 1)[0]]
            self._act = act if actor is None else trace(act, inputs, actor, mode)

    @contextmanager
    def steps(self, step: int, count: int) -> Iterator[list[tuple[Tensor, ...]]]:
        """The noise of ``count`` steps from ``step`` on, to be given to each call."""
        if self._streams is not None:
            yield self._streams.at(step, count)
            return
        with torch.random.fork_rng():
            torch.manual_seed(episode_seed(self._seed, self._first, step))
            yield [()] * count

    def __call__(self, inputs: Sequence[Tensor], noise: tuple[Tensor, ...]) -> Sequence[Tensor]:
        """The policy's outputs, ``[rows, ...]``."""
        if self._padded is None:
            return self._act(*inputs, *noise)
        for mine, x in zip(self._padded, inputs, strict=True):
            mine[self._own].copy_(x)
        return [x[self._own] for x in self._act(*self._padded, *noise)]


def trace(act: Act, inputs: Sequence[Tensor], actor: TensorDictModuleBase, mode: Mode = "off") -> Act:
    """A function of tensors like ``inputs`` that does what ``act``, which calls ``actor``, does.

    It is the actor's own sequence of tensor operations, recorded once and called without TensorDict: the same numbers
    bit for bit, at about a quarter of the cost for a small network. Compiled, it halves that again and rounds
    differently in the last bits. Parameters and buffers are referred to, not copied, so weights changed in place take
    effect; plain attributes are fixed. An actor that cannot be recorded (Python control flow that depends on data,
    numpy) is called as it is.

    Args:
        mode: of :func:`pgkit.compiled.compiled`; ``off`` records all the same, which changes no bit.
    """
    with torch.no_grad():
        return native_policy(act, inputs, actor, mode).bind(None, *inputs)


def native_policy(act: Act, inputs: Sequence[Tensor], actor: TensorDictModuleBase, mode: Mode) -> Compiled:
    """The function behind the door to native code, not bound yet; see :func:`trace`."""

    def function(_: None, *inputs: Tensor) -> Sequence[Tensor]:
        return act(*inputs)

    def others(_: None, *inputs: Tensor) -> list[tuple[Any, ...]]:
        return [(None, *(_other(x, seed, spread) for x in inputs)) for seed, spread in enumerate((0.1, 1.0, 10.0))]

    mode = "record" if mode == "off" else mode
    with torch.no_grad(), _LeavesTorch() as leaves:
        undone(actor.buffers(), lambda: act(*inputs))
    if leaves.seen:
        getLogger("pgkit").info("the policy computes outside torch: it is called as it is, several times slower")
        mode = "off"
    return compiled(function, watch={"the actor": actor}, others=others, mode=mode, name="the policy")


class _LeavesTorch(TorchFunctionMode):
    """Notices tensors that become numpy arrays or lists: what is computed from those is a constant of a record."""

    seen = False

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.seen |= func in (Tensor.numpy, Tensor.tolist, Tensor.__array__)
        return func(*args, **(kwargs or {}))


def _other(x: Tensor, seed: int, spread: float) -> Tensor:
    """Another input of the same type: noise on numbers, any pixels, flags and integers in another order."""
    draw = torch.Generator(x.device).manual_seed(seed)
    if x.dtype.is_floating_point:
        return x + spread * torch.randn(x.shape, generator=draw, dtype=x.dtype, device=x.device)
    if x.dtype is torch.uint8:
        return torch.randint(256, x.shape, generator=draw, dtype=x.dtype, device=x.device)
    return x.flatten()[torch.randperm(x.numel(), generator=draw, device=x.device)].view_as(x)
