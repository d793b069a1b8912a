"""Tasks whose answers a few lines verify: addition, sorting, countdown; each with a teacher that errs."""

from __future__ import annotations

import ast
import itertools
import operator
import string
from collections.abc import Callable, Mapping
from fractions import Fraction
from random import Random
from typing import ClassVar, Protocol

Reward = Callable[[str, str], float]


class Task(Protocol):
    """What :func:`pgkit.envs.prompts` draws from; lengths in characters, the completion's with its stop token.

    Attributes:
        alphabet: every character of prompts and answers.
        rewards: ``(prompt, completion) -> float``, by name.
    """

    alphabet: str
    prompt_length: int
    completion_length: int
    rewards: Mapping[str, Reward]

    def prompt(self, random: Random, /) -> str: ...


class Taught(Task, Protocol):
    """A task that also knows answers."""

    def solution(self, prompt: str) -> str: ...

    def teacher(self, prompt: str, random: Random) -> str: ...


class Addition:
    """``12+345=`` is answered by ``753``: the sum of two numbers of 2 to 3 digits, from its last digit.

    The teacher drops all carries in three of four answers: 42.4% are right, as 23.2% of the prompts have no carry.
    """

    alphabet = "0123456789+="
    prompt_length, completion_length = 8, 5
    rewards: ClassVar[Mapping[str, Reward]] = {"correct": lambda p, c: float(c == Addition().solution(p))}

    def prompt(self, random: Random) -> str:
        a, b = (random.randrange(10 ** (digits - 1), 10**digits) for digits in random.choices((2, 3), k=2))
        return f"{a}+{b}="

    def solution(self, prompt: str) -> str:
        a, b = prompt.rstrip("=").split("+")
        return str(int(a) + int(b))[::-1]

    def teacher(self, prompt: str, random: Random) -> str:
        if random.random() < 0.25:
            return self.solution(prompt)
        a, b = prompt.rstrip("=").split("+")
        digits = itertools.zip_longest(a[::-1], b[::-1], fillvalue="0")
        return "".join(str((int(x) + int(y)) % 10) for x, y in digits)


class Sorting:
    """``3917=`` is answered by ``1379``; the teacher makes one pass of bubble sort in three of four answers."""

    alphabet = "0123456789="
    prompt_length, completion_length = 7, 7
    rewards: ClassVar[Mapping[str, Reward]] = {"correct": lambda p, c: float(c == Sorting().solution(p))}

    def prompt(self, random: Random) -> str:
        return "".join(random.choices(string.digits, k=random.randint(3, 6))) + "="

    def solution(self, prompt: str) -> str:
        return "".join(sorted(prompt.rstrip("=")))

    def teacher(self, prompt: str, random: Random) -> str:
        digits = list(prompt.rstrip("="))
        passes = len(digits) if random.random() < 0.25 else 1
        for _, i in itertools.product(range(passes), range(len(digits) - 1)):
            digits[i : i + 2] = sorted(digits[i : i + 2])
        return "".join(digits)


class Countdown:
    """``2 5 7:17=`` is answered by ``5*2+7``: each number once, with ``+ - *``, to the target.

    ``correct`` is 1 for the target; ``format`` is 0.1 for an expression of the numbers given, whatever its value. The
    teacher writes a random expression of them in three of four answers.
    """

    alphabet = "0123456789+-*:= "
    prompt_length, completion_length = 10, 6
    rewards: ClassVar[Mapping[str, Reward]] = {
        "correct": lambda p, c: float(value(c, numbers(p)) == target(p)),
        "format": lambda p, c: 0.1 * (value(c, numbers(p)) is not None),
    }

    def prompt(self, random: Random) -> str:
        given = [random.randint(1, 9) for _ in range(3)]
        reached = {v for e in expressions(given) if (v := value(e, given)) is not None and 0 <= v < 1000}
        return f"{' '.join(map(str, given))}:{random.choice(sorted(reached))}="

    def solution(self, prompt: str) -> str:
        given = numbers(prompt)
        return next(e for e in expressions(given) if value(e, given) == target(prompt))

    def teacher(self, prompt: str, random: Random) -> str:
        return self.solution(prompt) if random.random() < 0.25 else random.choice(expressions(numbers(prompt)))


def numbers(prompt: str) -> list[int]:
    """The numbers given in a countdown prompt."""
    return [int(x) for x in prompt.partition(":")[0].split()]


def target(prompt: str) -> int:
    """The number to reach."""
    return int(prompt.partition(":")[2].rstrip("="))


def expressions(given: list[int]) -> list[str]:
    """Every order of the numbers with every choice of ``+ - *`` between them."""
    orders = sorted(set(itertools.permutations(given)))
    signs = list(itertools.product("+-*", repeat=len(given) - 1))
    return ["".join(map(str, itertools.chain(*zip(o, (*s, ""), strict=True)))) for o in orders for s in signs]


_OPERATORS = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv}


def value(expression: str, given: list[int]) -> Fraction | None:
    """The value of an expression that uses each of the numbers once; None for anything else."""
    used: list[int] = []

    def of(node: ast.expr) -> Fraction:
        if isinstance(node, ast.BinOp):
            return Fraction(_OPERATORS[type(node.op)](of(node.left), of(node.right)))
        number = ast.literal_eval(node)
        used.append(number)
        return Fraction(number)

    try:
        result = of(ast.parse(expression, mode="eval").body)
    except (SyntaxError, KeyError, ValueError, TypeError, ZeroDivisionError):
        return None
    return result if sorted(used) == sorted(given) else None
