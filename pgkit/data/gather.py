"""From row numbers of a replay buffer to a batch of transitions, in tensor operations that compile into the update."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from pgkit.data import stacks
from pgkit.seams import Key

_OWN = {"action", "reward", "terminated", "done", "next_row", "older"}
Gather = Callable[[TensorDictBase, Tensor], TensorDictBase]


def gather(
    data: TensorDictBase, index: Tensor, *, rows: int, n_steps: int, gamma: float | Tensor, stacked: Mapping[Key, int]
) -> TensorDictBase:
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
        stacked: observations that are stacks of so many frames. With ``n_steps=1`` an observation and the next one
            share the memory of the frames that both have: change neither in place.
    """
    frames = data["frames"]
    last, next_row, done = index, frames["next_row"][index].long(), frames["done"][index]
    reward, terminated = frames["reward"][index], frames["terminated"][index]
    steps = torch.ones_like(reward)
    for _ in range(n_steps - 1):
        goes_on = (next_row < rows).unsqueeze(-1)
        row = next_row.clamp_max(rows - 1)
        reward = reward + torch.where(goes_on, gamma**steps * frames["reward"][row], 0.0)  # an unused row may be NaN
        terminated = torch.where(goes_on, frames["terminated"][row], terminated)
        done = torch.where(goes_on, frames["done"][row], done)
        last = torch.where(goes_on.squeeze(-1), row, last)
        next_row = torch.where(goes_on.squeeze(-1), frames["next_row"][row].long(), next_row)
        steps = steps + goes_on
    observation, next_observation = _observations(data, index, last, next_row, stacked)
    batch = {**observation.to_dict(), "action": frames["action"][index]}
    batch["next"] = {**next_observation.to_dict(), "reward": reward, "terminated": terminated, "done": done}
    batch |= {key: x[index] for key, x in frames.items() if key not in _OWN}
    if n_steps > 1:
        batch["steps_to_next_obs"] = steps
    if "weighting" in data.keys():
        priority, beta = data["weighting"]["priority"][index], data["weighting"]["beta"]
        batch["priority_weight"] = ((priority / priority.min()) ** -beta).to(reward.dtype)
    return TensorDict(batch, batch_size=index.shape)


def _observations(
    data: TensorDictBase, index: Tensor, last: Tensor, next_row: Tensor, stacked: Mapping[Key, int]
) -> tuple[TensorDictBase, TensorDictBase]:
    """Observations at the rows ``index``, and at ``next_row``, the step after the rows ``last``."""
    whole = data["observations"].exclude(*stacked) if stacked else data["observations"]
    now, after = cast(TensorDictBase, whole[index]), cast(TensorDictBase, whole[next_row])
    if not stacked:
        return now, after
    older = data["frames"]["older"]
    rows = torch.cat([older[index], index.unsqueeze(1)], 1)
    next_rows = torch.cat([older[last][:, 1:], last.unsqueeze(1), next_row.unsqueeze(1)], 1)
    for key, k in stacked.items():
        frames = data["observations"][key]
        if last is index:  # both stacks are in one row of frames
            both = stacks.gather(frames, torch.cat([rows[:, -k:], next_row.unsqueeze(1)], 1))
            size = k * frames.shape[1]
            now[key], after[key] = both[:, :size], both[:, -size:]
        else:
            now[key], after[key] = stacks.gather(frames, rows[:, -k:]), stacks.gather(frames, next_rows[:, -k:])
    return now, after
