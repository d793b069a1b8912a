"""The contracts between blocks, as Protocols: what a block must have, and nothing that asks for more.

A block is anything that meets its seam; nothing has to be subclassed. ``docs/pages/house.md`` shows each in use.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

Key: TypeAlias = str | tuple[str, ...]
Entries: TypeAlias = dict[Key, Tensor]
"""Tensors by nested key: a second observation, a second group of agents or an ``info`` entry is nothing new."""


class Step(NamedTuple):
    """What a simulator's step gives. Its tensors may be overwritten by the next step: copy what is to stay.

    Attributes:
        next: the true next observations, never those after a reset.
        reward: by the keys of ``reward_spec``, ``[N, 1]``, with agents ``[N, A, 1]``.
        terminated, truncated: by the keys of ``done_spec`` that end in these names, shaped as ``done``.
        info: the entries of ``info_spec``.
        fresh: what the policy reads next: as ``next``, where an episode ended the first observation of the new one.
        mask: bool ``[N]``, where the action counted; None: everywhere. Where it did not, an episode began instead.
    """

    next: Entries
    reward: Entries
    terminated: Entries
    truncated: Entries
    info: Entries
    fresh: Entries
    mask: Tensor | None = None

    def ended(self) -> Tensor:
        """Bool ``[N]``: where an episode ended; with agents, the flag at the root, else all agents together."""
        if "terminated" in self.terminated:
            return (self.terminated["terminated"] | self.truncated["truncated"]).flatten()
        pairs = zip(self.terminated.values(), self.truncated.values(), strict=True)
        return torch.stack([(a | b).flatten(1).all(1) for a, b in pairs]).all(0)

    def begun(self) -> Tensor:
        """Bool ``[N]``: where ``fresh`` is the first observation of an episode."""
        return self.ended() if self.mask is None else ~self.mask


@runtime_checkable
class Simulator(Protocol):
    """Many environments that step together and begin anew by themselves, on one device.

    Attributes:
        num_envs: number of environments, ``N``.
        device: where its tensors live.
        observation_spec, action_spec, reward_spec, done_spec: TorchRL's, of batch size ``[N]``; entries of a group of
            agents lie under its name.
        info_spec: further entries that a step gives.
        resume: what :meth:`state_dict` promises: every environment ``exact`` as it was, or ``new episodes``.
        masks: whether :attr:`Step.mask` is given.
        episode_reward: return so far of the episodes that the last step belonged to, before any reset; by the rewards'
            keys.
        step_count: their length so far, int64 ``[N]``.
    """

    num_envs: int
    device: torch.device
    observation_spec: Composite
    action_spec: Composite
    reward_spec: Composite
    done_spec: Composite
    info_spec: Composite
    resume: Literal["exact", "new episodes"]
    masks: bool
    episode_reward: Entries
    step_count: Tensor

    def reset(self, seed: int | None = None, rows: Tensor | None = None) -> Entries:
        """Begins an episode everywhere, or where ``rows [N]`` is set, unless one has just begun; what the policy reads.

        With ``seed``, everything is as in a new simulator with that seed.
        """
        ...

    def step(self, action: Entries) -> Step:
        """Steps every environment; those whose episode ends begin the next one."""
        ...

    def to_env(self, actions: np.ndarray, /) -> np.ndarray:
        """A policy's actions ``[B, ...]`` as one environment takes them: within bounds, of its type."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Where environments have a state each, they are the items of its list ``rows``."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> Entries:
        """Goes on from :meth:`state_dict` as :attr:`resume` says; what the policy reads next.

        ``{"steps": n}`` stands for a state that is lost after ``n`` steps: episodes begin that none has had before.
        """
        ...

    def close(self) -> None: ...


class MakeSimulator(Protocol):
    """A picklable factory of a share of the environments, for workers and for Ray."""

    def __call__(self, first: int, count: int, seed: int) -> Simulator:
        """The environments ``first`` to ``first + count`` of a larger vector with this seed."""
        ...


class Advantage(Protocol):
    """``rollout [N, T]`` to the rollout with ``advantage`` and ``value_target``, ``[N, T, 1]``."""

    def __call__(self, rollout: TensorDictBase, /) -> TensorDictBase: ...


class Loss(Protocol):
    """A ``LossModule``: every ``loss_*`` entry is summed and minimized, every other entry is a detached scalar."""

    def __call__(self, batch: TensorDictBase, /) -> TensorDictBase: ...


@runtime_checkable
class KeepsDistribution(Protocol):
    """A loss of a policy that measures how far the policy has moved, as a trust region needs it."""

    def keep_distribution(self, batch: TensorDictBase, /) -> TensorDictBase:
        """Writes the parameters of the policy's distribution into the batch, as of now."""
        ...

    def kl(self, batch: TensorDictBase, /) -> Tensor:
        """Divergence ``[*B]`` of the present distribution from the one kept in the batch."""
        ...


@runtime_checkable
class Memory(Protocol):
    """A module whose state goes from step to step: a recurrent core, correlated noise.

    Attributes:
        state_key: entry of the state before a step; the one after it lies below ``next``.
        state_shape: shape of one environment's state.
    """

    state_key: Any
    state_shape: Sequence[int]


@runtime_checkable
class Noisy(Protocol):
    """A layer that explores by noise of its weights, in training mode."""

    def reset_noise(self) -> None: ...


@runtime_checkable
class Replay(Protocol):
    """What an off-policy update stores rollouts in and draws batches from."""

    def __len__(self) -> int: ...

    def extend(self, data: TensorDictBase, /) -> Any: ...

    def sample(self, batch_size: int, /) -> TensorDictBase: ...


class Stateful(Protocol):
    """What a checkpoint saves and loads."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any], /) -> Any: ...


class Update(Stateful, Protocol):
    """``update(data) -> metrics``: one update, with its epochs, minibatches, optimizer and state."""

    @property
    def compile_seconds(self) -> float: ...

    def __call__(self, data: TensorDictBase, /) -> dict[str, float]: ...


class Collector(Stateful, Protocol):
    """An iterable of rollouts ``[N, T]``; ``frames`` counts the real ones so far."""

    frames: int
    compile_seconds: float

    def __iter__(self) -> Iterator[TensorDictBase]: ...

    def shutdown(self) -> None: ...


class Augmentation(Protocol):
    """``batch -> batch``: a change of a minibatch before the loss reads it, inside the compiled step."""

    def __call__(self, batch: TensorDictBase, /) -> TensorDictBase: ...
