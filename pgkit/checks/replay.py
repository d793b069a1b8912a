"""What an update has to know of a TorchRL replay buffer, and the check of what goes into it."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data import PrioritizedSampler, ReplayBuffer
from torchrl.envs import MultiStepTransform

from pgkit.checks.view import name_of
from pgkit.errors import UserError
from pgkit.seams import Replay


def check_replay(buffer: Any) -> None:
    """A ``UserError`` for what is no replay buffer."""
    if not isinstance(buffer, Replay):
        raise UserError(f"the update draws from a replay buffer, this is a {name_of(buffer)}: use data.ReplayBuffer")


def prioritized(buffer: Any) -> bool:
    """Whether it draws by priorities, which the update writes back."""
    return isinstance(buffer, ReplayBuffer) and isinstance(buffer.sampler, PrioritizedSampler)


def transforms(buffer: Any) -> dict[str, Any]:
    """Its transforms by a name for a message; one of several steps has a ``gamma`` of its own."""
    held: Any = buffer.transform if isinstance(buffer, ReplayBuffer) else ()
    return {f"{name_of(transform)} of {name_of(buffer)}": transform for transform in held}


def check_rollout(buffer: Any, rollout: TensorDictBase) -> None:
    """A ``UserError`` where the buffer's transform would add up rewards of several environments."""
    several = rollout.batch_dims > 1 and rollout.batch_size[0] > 1
    if several and any(isinstance(transform, MultiStepTransform) for transform in transforms(buffer).values()):
        raise UserError(
            f"TorchRL's MultiStepTransform would add up rewards of {rollout.batch_size[0]} environments: collect "
            "with one, or use pgkit.data.ReplayBuffer(env, n_steps=...)"
        )
