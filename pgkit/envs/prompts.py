"""Prompts with a verifier as an environment: an episode is one completion."""

from __future__ import annotations

import math
import string
import zlib
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded

from pgkit.envs.prompt_gym import GymTask
from pgkit.envs.prompt_tasks import Addition, Countdown, Reward, Sorting, Task
from pgkit.envs.tokenizers import Characters, Tokenizer
from pgkit.errors import UserError, check_whole_number
from pgkit.seams import Entries, Step

TASKS: dict[str, Callable[[], Any]] = {"addition": Addition, "sorting": Sorting, "countdown": Countdown}


def prompts(
    task: str | Task | Sequence[str] | Callable[[Random], str],
    batch: int = 64,
    *,
    reward: Reward | Mapping[str, Reward] | None = None,
    tokenizer: Tokenizer | None = None,
    prompt_length: int | None = None,
    completion_length: int | None = None,
    held_out: bool = False,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Prompts:
    """An environment of prompts, of which a verifier knows what a completion is worth.

    Args:
        task: ``addition``, ``sorting`` or ``countdown``; ``reasoning_gym/NAME`` (extra ``reasoning``); a list of
            prompts; a function of a ``random.Random`` that draws one; or an object like those of ``envs.prompt_tasks``.
        batch: prompts drawn at once, ``N``.
        reward: ``(prompt, completion) -> float``, or several by name, which add up; by default the task's own.
        tokenizer: by default a character a token.
        prompt_length, completion_length: tokens, the latter with the stop token; by default the task's own.
        held_out: draw from the tenth of a task's prompts that training never sees; a list is used as it is.
        seed: of the prompts drawn.
        device: of the tokens.

    Raises:
        UserError: there is no such task, or nothing says what a completion is worth or how long it may be.
    """
    made = _task(task)
    rewards = made.rewards if reward is None else {"reward": reward} if callable(reward) else dict(reward)
    lengths = {
        "prompt_length": prompt_length or made.prompt_length,
        "completion_length": completion_length or made.completion_length,
    }
    if not rewards:
        raise UserError(
            "nothing says what a completion is worth: give reward=, a function (prompt, completion) -> float"
        )
    if missing := [name for name, length in lengths.items() if not length]:
        raise UserError(f"prompts of your own need {missing[0]}=, in tokens")
    check_whole_number(1, batch=batch, **lengths)
    return Prompts(
        made,
        batch,
        rewards=rewards,
        tokenizer=tokenizer or Characters(made.alphabet),
        held_out=None if isinstance(task, Sequence) and not isinstance(task, str) else held_out,
        seed=seed,
        device=device,
        **lengths,
    )


class Own:
    """Prompts of a user: a list, or a function that draws one; rewards and lengths are still to be given."""

    alphabet = string.printable[:95]
    prompt_length = completion_length = 0
    rewards: Mapping[str, Reward] = {}

    def __init__(self, draw: Callable[[Random], str]) -> None:
        self.prompt = draw


def _task(task: str | Task | Sequence[str] | Callable[[Random], str]) -> Task:
    if isinstance(task, str):
        if task.startswith("reasoning_gym/"):
            return GymTask(task.removeprefix("reasoning_gym/"))
        if task not in TASKS:
            raise UserError(f"no task '{task}': there are {', '.join(TASKS)}, reasoning_gym/NAME, a list, a function")
        return TASKS[task]()
    if isinstance(task, Sequence):
        if not task:
            raise UserError("the list of prompts is empty")
        return Own(lambda random: random.choice(task))
    return Own(task) if callable(task) else task


class Prompts:
    """A :class:`~pgkit.seams.Simulator` of one-step episodes; the arguments are those of :func:`prompts`.

    ``observation [N, P]`` is a prompt's tokens, -1 at the padding on its left; the action ``[N, C]`` is a completion.

    Attributes:
        texts: the prompts drawn last.
        vocab_size, stop, pad, context: what a model must know.
    """

    resume: Literal["exact", "new episodes"] = "exact"
    masks = False

    def __init__(
        self,
        task: Task,
        batch: int,
        *,
        rewards: Mapping[str, Reward],
        tokenizer: Tokenizer,
        prompt_length: int,
        completion_length: int,
        held_out: bool | None,
        seed: int,
        device: torch.device | str,
    ) -> None:
        self.task, self.num_envs, self.rewards, self.tokenizer = task, batch, rewards, tokenizer
        self.prompt_length, self.completion_length = prompt_length, completion_length
        self.held_out, self.device = held_out, torch.device(device)
        self.vocab_size, self.stop, self.pad = tokenizer.vocab_size, tokenizer.stop, tokenizer.pad
        self.context = prompt_length + completion_length
        self._random, self.texts = Random(seed), list[str]()
        flag = Unbounded((batch, 1), dtype=torch.bool)
        tokens = {"dtype": torch.int64, "device": self.device}
        observed = Bounded(-1, self.vocab_size - 1, (batch, prompt_length), **tokens)
        acted = Bounded(0, self.vocab_size - 1, (batch, completion_length), **tokens)
        self.observation_spec = Composite(observation=observed, shape=(batch,))
        self.action_spec = Composite(action=acted, shape=(batch,))
        self.reward_spec = Composite(reward=Unbounded((batch, 1)), shape=(batch,))
        self.info_spec = Composite(shape=(batch,))
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(batch,))
        self.episode_reward: Entries = {"reward": torch.zeros(batch, 1)}
        self.step_count = torch.zeros(batch, dtype=torch.int64)
        self.observation_spec_unbatched, self.action_spec_unbatched = self.observation_spec[0], acted[0]

    def set_seed(self, seed: int) -> None:
        """Of the prompts drawn from now on."""
        self._random.seed(seed)

    def reset(self, seed: int | None = None, rows: Tensor | None = None) -> Entries:
        """Draws ``N`` prompts, or those where ``rows [N]`` is set."""
        if seed is not None:
            self._random.seed(seed)
        anew = [True] * self.num_envs if rows is None or not self.texts else rows.tolist()
        self.texts = [self._draw() if new else text for new, text in zip(anew, self.texts or anew, strict=True)]
        return {"observation": self.encode(self.texts)}

    def step(self, action: Entries) -> Step:
        """What the completions are worth; then new prompts."""
        scores = self.verify(self.texts, action["action"])
        reward = torch.stack(list(scores.values())).sum(0).unsqueeze(-1)
        self.episode_reward, self.step_count = {"reward": reward}, torch.ones_like(self.step_count)
        ended = torch.ones_like(reward, dtype=torch.bool)
        before, fresh = self.encode(self.texts), self.reset()
        return Step(
            {"observation": before}, {"reward": reward}, {"terminated": ended}, {"truncated": ~ended}, {}, fresh
        )

    def encode(self, texts: Sequence[str]) -> Tensor:
        """Prompts as tokens ``[N, P]``, -1 at the padding on the left.

        Raises:
            UserError: a prompt is longer than ``prompt_length``.
        """
        rows = [self.tokenizer.encode(text) for text in texts]
        for text, row in zip(texts, rows, strict=True):
            if len(row) > self.prompt_length:
                raise UserError(
                    f"the prompt {text[:60]!r} has {len(row)} tokens, prompt_length={self.prompt_length}: raise it, or "
                    "leave such prompts out"
                )
        padded = [[-1] * (self.prompt_length - len(row)) + row for row in rows]
        return torch.tensor(padded, dtype=torch.int64, device=self.device)

    def completions(self, texts: Sequence[str]) -> Tensor:
        """Answers as tokens ``[N, C]``: each with its stop token, then padding."""
        rows = [[*self.tokenizer.encode(text), self.stop][: self.completion_length] for text in texts]
        padded = [row + [self.pad] * (self.completion_length - len(row)) for row in rows]
        return torch.tensor(padded, dtype=torch.int64, device=self.device)

    def rows(self, texts: Sequence[str], answers: Sequence[str]) -> TensorDict:
        """Prompts with given answers as token rows ``[N]``, for supervised learning; longer answers are cut."""
        prompt, completion = self.encode(texts), self.completions(answers)
        seen, nothing = prompt >= 0, torch.zeros_like(prompt, dtype=torch.bool)
        ended = (completion == self.stop).cumsum(1) - (completion == self.stop).int() > 0  # beyond the stop token
        masks = {
            "all_attention_mask": torch.cat([seen, ~ended], 1),
            "all_assistant_mask": torch.cat([nothing, ~ended], 1),
        }
        tokens = torch.cat([torch.where(seen, prompt, self.pad), completion], 1)
        return TensorDict({"tokens": {"full": tokens}, "masks": masks}, [len(tokens)])

    def decode(self, completions: Tensor) -> list[str]:
        """Completions ``[N, C]`` as texts, up to the stop token."""
        rows = completions.tolist()
        return [self.tokenizer.decode(row[: row.index(self.stop)] if self.stop in row else row) for row in rows]

    def verify(self, texts: Sequence[str], completions: Tensor) -> dict[str, Tensor]:
        """Every reward of each completion ``[N, C]`` of the prompts ``texts``, by name: ``[N]``.

        Raises:
            UserError: a reward is no finite number.
        """
        answers = self.decode(completions)
        return {
            name: torch.tensor(
                [_number(name, reward(prompt, answer), prompt, answer)
                 for prompt, answer in zip(texts, answers, strict=True)],
                device=self.device,
            )
            for name, reward in self.rewards.items()
        }  # fmt: skip

    def draw(self, count: int) -> list[str]:
        """So many prompts, as texts."""
        return [self._draw() for _ in range(count)]

    def _draw(self) -> str:
        for _ in range(10_000):
            text = self.task.prompt(self._random)
            if self.held_out is None or (zlib.crc32(text.encode()) % 10 == 0) == self.held_out:
                return text
        raise UserError("the task draws too few prompts to hold a tenth of them out: give prompts as lists")

    def state_dict(self) -> dict[str, Any]:
        return {"random": self._random.getstate(), "texts": list(self.texts)}

    def load_state_dict(self, state: dict[str, Any]) -> Entries:
        """Restores :meth:`state_dict`; the prompts drawn last."""
        self._random.setstate(state["random"])
        self.texts = list(state["texts"])
        return {"observation": self.encode(self.texts)} if self.texts else self.reset()

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """Completions as they are."""
        return actions

    def close(self) -> None: ...


def _number(name: str, reward: Any, prompt: str, answer: str) -> float:
    try:
        value = float(reward)
    except (TypeError, ValueError, RuntimeError):
        raise UserError(
            f"the reward '{name}' of prompt {prompt!r} and completion {answer!r} is {reward!r}: return one number"
        ) from None
    if not math.isfinite(value):
        raise UserError(
            f"the reward '{name}' of prompt {prompt!r} and completion {answer!r} is {value}: return a finite number"
        )
    return value
