"""Text as tokens: one a character. Any object with these members will do, see ``modules.hugging_face_tokenizer``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from pgkit.errors import UserError


class Tokenizer(Protocol):
    """What :func:`pgkit.envs.prompts` asks of a tokenizer; ``stop`` ends a completion."""

    vocab_size: int
    stop: int
    pad: int

    def encode(self, text: str) -> list[int]: ...

    def decode(self, tokens: Sequence[int]) -> str: ...


class Characters:
    """One token a character of ``alphabet``, from 2 on; 0 is padding, 1 ends a completion."""

    pad, stop = 0, 1

    def __init__(self, alphabet: str) -> None:
        self.alphabet = alphabet
        self.vocab_size = len(alphabet) + 2
        self._number = {character: number for number, character in enumerate(alphabet, 2)}

    def encode(self, text: str) -> list[int]:
        """The tokens of a text.

        Raises:
            UserError: a character is not in the alphabet.
        """
        if unknown := [character for character in text if character not in self._number]:
            raise UserError(
                f"{text!r} has {unknown[0]!r}, the tokenizer knows only {self.alphabet!r}: give "
                "tokenizer=envs.Characters(alphabet) with every character of prompts and answers"
            )
        return [self._number[character] for character in text]

    def decode(self, tokens: Sequence[int]) -> str:
        """The text of tokens; padding and stop tokens have none."""
        return "".join(self.alphabet[token - 2] for token in tokens if token > 1)
