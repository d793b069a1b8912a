"""What a minibatch is made of: single rows, or sequences of steps for recurrent networks."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import nn

from pgkit.errors import UserError


def as_rows(data: TensorDictBase, length: int | None) -> TensorDictBase:
    """The rows that minibatches are drawn from: ``[rows]``, or sequences ``[rows, length]`` of successive steps.

    Raises:
        UserError: recurrent networks without a length, or a length that does not divide the rollout's steps.
    """
    if length is None:
        if "recurrent_state" in data.keys():
            raise UserError(
                "the networks are recurrent, single rows do not train their memory: use OnPolicyUpdate with "
                "sequence_length= (16, say)"
            )
        return data.reshape(-1).contiguous()
    if data.batch_size[-1] % length:
        raise UserError(
            f"sequence_length={length} does not divide the {data.batch_size[-1]} steps that each environment takes for "
            "a rollout: change one of them"
        )
    return data.reshape(-1, length).contiguous()


def check_one_memory(loss: nn.Module, advantage: Any) -> None:
    """A recurrent critic must use the actor's core: a rollout has that one's state and no other.

    Raises:
        UserError: the critic has a core of its own.
    """
    actor = getattr(loss, "actor_network_params", None)
    if actor is None or not isinstance(advantage, nn.Module):
        return
    held = {id(p) for p in actor.values(True, True)}
    for module in advantage.modules():
        if hasattr(module, "state_size") and any(id(p) not in held for p in module.parameters()):
            raise UserError(
                f"the critic of {type(advantage).__name__} has a recurrent core of its own, the rollout has the state "
                "of the actor's only: make one core = modules.gru(env) and give it to both as encoder="
            )


def check_time(rollout: TensorDictBase) -> None:
    """A flat rollout must be one environment's steps: an advantage runs along the last dimension.

    Raises:
        UserError: a step goes on where the one before it did not end.
    """
    after: Any = rollout.get("next", None)
    if rollout.batch_dims != 1 or after is None or "observation" not in after.keys():
        return
    reached, seen = after["observation"][:-1], rollout["observation"][1:]
    broken = (reached != seen).flatten(1).any(-1) & ~after["done"][:-1].squeeze(-1)
    if broken.any():
        step = int(broken.nonzero()[0])
        raise UserError(
            f"the rollout of batch size [{len(rollout)}] is not one environment's: step {step + 1} does not begin "
            f"where step {step} led. Give the rollout as [environments, steps], time last, not flattened"
        )
