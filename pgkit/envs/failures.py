"""What is raised where an environment's own code fails: it names the environment, the step and the seed."""

from __future__ import annotations

from logging import getLogger
from typing import Any, NoReturn

from pgkit.envs.limits import Overdue
from pgkit.errors import EnvironmentFailed, EnvironmentHung, UserError, frames_of

FAILURES = (Exception, SystemExit, Overdue)  # what an environment may raise, besides an interrupt
LONGEST = 100_000  # steps of an episode whose actions are kept, so that a resume can replay it


def fail(where: str, error: BaseException) -> NoReturn:
    """Raises in place of an environment's error one that says where; a UserError stays as it is."""
    if isinstance(error, EnvironmentFailed | UserError):
        raise error
    frames = frames_of(error.__traceback__)
    if isinstance(error, Overdue):
        raise EnvironmentHung(f"{where}: {error}", frames) from error
    what = f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'}"
    if isinstance(error, SystemExit):
        what = f"it called sys.exit({error.code})"
    raise EnvironmentFailed(f"{where}: {what}", frames) from error


def in_episode(env: Any, index: int, step: int, seed: int | None) -> str:
    """Where one environment failed: step 0 is the reset."""
    when = f"step {step:,} of the episode of reset(seed={seed})" if step else f"reset(seed={seed})"
    return f"environment {index} ({type(env).__name__}), {when}"


def in_vector(env: Any, first: int, count: int, step: int, seed: int) -> str:
    """Where a vector of environments that step as one failed: step 0 is a reset."""
    last = f" to {first + count - 1}" if count > 1 else ""
    when = f"step {step:,} since the start" if step else "reset"
    return f"environment{'s' if last else ''} {first}{last} ({type(env).__name__}, seed {seed}), {when}"


def warn_of_length(env: Any, index: int) -> None:
    """Says that an episode has become too long to be replayed by a resume."""
    getLogger("pgkit").warning(
        "the episode of environment %d (%s) has come to %s steps: its actions are kept no longer, a resume begins a "
        "new one; envs.make(id, max_episode_steps=...) sets a time limit", index, type(env).__name__, f"{LONGEST:,}",
    )  # fmt: skip
