"""What a driver knows of environments in another process, so that they can be made again when it dies."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from torch import Tensor

from pgkit.collectors.actor import is_state
from pgkit.envs import VectorEnv
from pgkit.seams import Entries, Key

_MOST_STEPS = 2000  # that are taken again after a process's death


class Past(NamedTuple):
    """Brings a new :class:`~pgkit.collectors.stepping.Share` to where another one was.

    Attributes:
        state: of ``Share.state_dict()``, pickled; None: it had just been made.
        actions: taken since, ``[T, n, ...]`` a rollout.
        memory: the states ``[n, ...]`` that the policy wrote in the last of those steps, by its output keys.
    """

    state: bytes | None
    actions: list[Entries]
    memory: dict[Key, Tensor]


class Known:
    """The past of a share of ``count`` environments: a state that it told some time ago, and the actions since.

    Of environments that begin new episodes (``resume``), it has the state as of the last rollout.

    Args:
        outputs: what the policy writes.
    """

    def __init__(self, env: VectorEnv, count: int, outputs: Iterable[Key]) -> None:
        self._exact, self._actions, self._count = env.resume == "exact", env.action_keys, count
        self._states = [key for key in outputs if is_state(key)]
        self._steps = self._rollouts = 0
        self.past = Past(None, [], {})

    def asks(self) -> bool:
        """Whether the share is to tell its state with its next rollout."""
        return not self._exact or self._steps >= _MOST_STEPS

    def collected(self, buffers: Entries, state: bytes | None) -> None:
        """Notes a rollout's ``[T, n, ...]``, and the state after it where the share told it."""
        self._rollouts += 1
        if state is not None:
            self.told(state)
            return
        actions = {key: buffers[key].clone() for key in self._actions}
        memory = {key: buffers[key][-1].clone() for key in self._states}
        self.past = Past(self.past.state, [*self.past.actions, actions], memory)
        self._steps += len(next(iter(actions.values())))

    def told(self, state: bytes) -> None:
        """Notes the state as of now."""
        self._steps, self.past = 0, Past(state, [], {})

    def lost(self) -> int:
        """How many episodes a death ends."""
        return 0 if self._exact or not self._rollouts else self._count
