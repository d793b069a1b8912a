"""The last few rollouts as one, for on-policy updates that reuse them."""

from __future__ import annotations

from collections import deque
from typing import Any, cast

import torch
from tensordict import TensorDictBase


class Recent:
    """``recent(rollout) -> rollouts``: the newest rollout ``[N, T]`` above those before it, ``[rollouts * N, T]``.

    While there are too few, copies of the first stand for the missing ones: the shape never changes, so nothing is
    compiled twice.

    Args:
        rollouts: how many to keep, the newest included.
    """

    def __init__(self, rollouts: int) -> None:
        self._kept: deque[TensorDictBase] = deque(maxlen=rollouts)

    def __call__(self, rollout: TensorDictBase) -> TensorDictBase:
        """A new TensorDict; what is written into it is not kept."""
        self._kept.appendleft(rollout.clone())
        while len(self._kept) < cast(int, self._kept.maxlen):
            self._kept.append(rollout.clone())
        device = next(iter(rollout.values(True, True))).device  # a checkpoint brings the others to the CPU
        return cast(TensorDictBase, torch.cat([kept.to(device) for kept in self._kept], 0))

    def state_dict(self) -> dict[str, Any]:
        """The rollouts that are kept."""
        return {"kept": list(self._kept)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self._kept.clear()
        self._kept.extend(state["kept"])
