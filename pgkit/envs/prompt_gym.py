"""Tasks of reasoning-gym, whose verifiers need the entry that a prompt came from."""

from __future__ import annotations

import string
from collections.abc import Mapping
from random import Random
from typing import Any

from pgkit.envs.prompt_tasks import Reward
from pgkit.errors import UserError


class GymTask:
    """``reasoning_gym/NAME``: ``chain_sum`` and ``basic_arithmetic`` suit a character model.

    The verifiers of some tasks give a wrong answer more than 0. Prompts and answers may be longer than the lengths
    here: give ``prompt_length`` and ``completion_length``.

    Args:
        name: the data set's.
        size: prompts to draw from.
        settings: the data set's own.
    """

    alphabet = string.printable[:95] + "\n"
    prompt_length, completion_length = 96, 16

    def __init__(self, name: str, size: int = 10_000, **settings: Any) -> None:
        try:
            import reasoning_gym
        except ImportError:
            raise UserError(f"reasoning_gym/{name} needs reasoning-gym: pip install 'pgkit-rl[reasoning]'") from None
        try:
            self.data = reasoning_gym.create_dataset(name, size=size, seed=0, **settings)
        except ValueError as error:
            raise UserError(f"reasoning_gym/{name}: {error}") from error
        self.rewards: Mapping[str, Reward] = {"reward": self.score}
        self._entries: dict[str, dict[str, Any]] = {}

    def prompt(self, random: Random) -> str:
        entry = self.data[random.randrange(len(self.data))]
        self._entries[entry["question"]] = entry
        return entry["question"]

    def score(self, prompt: str, completion: str) -> float:
        """The data set's own score of an answer, in [0, 1]."""
        return float(self.data.score_answer(completion, self._entries[prompt]))
