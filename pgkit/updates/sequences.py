"""What a minibatch is made of: single rows, or sequences of steps for recurrent networks."""

from __future__ import annotations

from tensordict import TensorDictBase

from pgkit.errors import UserError


def as_rows(data: TensorDictBase, length: int | None) -> TensorDictBase:
    """The rows that minibatches are drawn from: ``[rows]``, or sequences ``[rows, length]`` of successive steps.

    Raises:
        UserError: recurrent networks without a length, or a length that does not divide the rollout's steps.
    """
    if length is None:
        if any(key == "recurrent_state" or key[-1] == "recurrent_state" for key in data.keys(True)):
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
