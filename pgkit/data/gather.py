"""From row numbers of a replay buffer to a batch of transitions, in tensor operations that compile into the update."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

_OWN = {"action", "reward", "terminated", "done", "next_row"}
Gather = Callable[[TensorDictBase, Tensor], TensorDictBase]


def gather(data: TensorDictBase, index: Tensor, *, rows: int, n_steps: int, gamma: float | Tensor) -> TensorDictBase:
    r"""The transitions at ``index``, with n-step returns.

    .. math:: R_t = \sum_{k=0}^{m-1} \gamma^k r_{t+k}, \qquad m = \min(n, \text{steps to the end of the episode})

    The next observation is that of step :math:`t + m`, the true final one where the episode ended; ``terminated`` and
    ``done`` are those of step :math:`t + m - 1`, so a truncation bootstraps and a termination does not.

    Args:
        data: :attr:`pgkit.data.ReplayBuffer.data`.
        index: rows ``[B]``.
        rows: rows of ``data``'s frames; a ``next_row`` from there on is a final observation.
        n_steps: :math:`n`.
        gamma: :math:`\gamma`, for the sum of rewards.
    """
    frames, observations = data["frames"], data["observations"]
    next_row, done = frames["next_row"][index].long(), frames["done"][index]
    reward, terminated = frames["reward"][index], frames["terminated"][index]
    steps = torch.ones_like(reward)
    for _ in range(n_steps - 1):
        goes_on = (next_row < rows).unsqueeze(-1)
        row = next_row.clamp_max(rows - 1)
        reward = reward + torch.where(goes_on, gamma**steps * frames["reward"][row], 0.0)  # an unused row may be NaN
        terminated = torch.where(goes_on, frames["terminated"][row], terminated)
        done = torch.where(goes_on, frames["done"][row], done)
        next_row = torch.where(goes_on.squeeze(-1), frames["next_row"][row].long(), next_row)
        steps = steps + goes_on
    batch = {**observations[index].to_dict(), "action": frames["action"][index]}
    batch["next"] = {
        **observations[next_row].to_dict(),
        "reward": reward,
        "terminated": terminated,
        "done": done,
    }
    batch |= {key: x[index] for key, x in frames.items() if key not in _OWN}
    if n_steps > 1:
        batch["steps_to_next_obs"] = steps
    if "weighting" in data.keys():
        priority, beta = data["weighting"]["priority"][index], data["weighting"]["beta"]
        batch["priority_weight"] = ((priority / priority.min()) ** -beta).to(reward.dtype)
    return TensorDict(batch, batch_size=index.shape)
