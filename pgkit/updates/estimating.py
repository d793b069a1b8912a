"""Who estimates a rollout's advantage: the update's block, or the loss by itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import nn

from pgkit.errors import UserError
from pgkit.updates.sequences import check_time


def estimated(
    loss: nn.Module, advantage: Callable[[TensorDictBase], TensorDictBase] | None, rollout: TensorDictBase
) -> TensorDictBase:
    """The rollout ``[num_envs, T]`` with what ``advantage`` writes.

    Without one, a loss of a policy that was given an estimator (TorchRL's ``make_value_estimator``) uses it here, on
    the rollout: in the loss it would take a minibatch's rows for steps.

    Raises:
        UserError: the block returns no TensorDict; or nothing writes the advantage, and the loss would make itself an
            estimator for its minibatches.
    """
    if advantage is not None:
        result: Any = advantage(rollout)
        if not isinstance(result, TensorDictBase):
            raise UserError(
                f"the advantage block {getattr(advantage, '__name__', type(advantage).__name__)} returned a "
                f"{type(result).__name__}: return the rollout, with 'advantage' and 'value_target' in it"
            )
        return result
    key = getattr(getattr(loss, "tensor_keys", None), "advantage", None)
    unread = hasattr(loss, "_reads") and key not in cast(Any, loss).in_keys  # pgkit's losses name all that they read
    if key is None or unread or key in rollout.keys(True) or not hasattr(loss, "actor_network"):
        return rollout
    estimator: Any = getattr(loss, "_value_estimator", None)
    if estimator is None:
        raise UserError(
            f"the rollout has no '{key}', which {type(loss).__name__} reads; nothing writes it, as there is no "
            "advantage block: add advantage=advantages.GAE(critic)"
        )
    check_time(rollout)
    rollout = rollout.copy()  # the next epoch finds none there, and estimates again if it is to
    params = getattr(loss, "critic_network_params", None)
    with torch.no_grad():
        estimator(
            rollout,
            params=None if params is None else params.detach(),
            target_params=getattr(loss, "target_critic_network_params", None),
        )
    return rollout
