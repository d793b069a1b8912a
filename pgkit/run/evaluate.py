"""Evaluation: whole episodes, deterministic actions, the same number from every env slot."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from logging import getLogger
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit.errors import UserError, check_whole_number
from pgkit.run.seeding import preserved_rng

Entries = Mapping[str, torch.Tensor]
LONG_EPISODE = 100_000  # steps; longer than those of Gymnasium, dm_control and Atari


@contextmanager
def _evaluating(policy: torch.nn.Module) -> Iterator[None]:
    """Evaluation mode, and one thread: for a few rows a second thread costs more than it brings."""
    training, threads = [(part, part.training) for part in policy.modules()], torch.get_num_threads()
    policy.eval()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        for part, mode in training:
            part.training = mode


class Acting:
    """A policy on plain arrays; a recurrent one remembers from call to call.

    Args:
        policy: a TensorDict actor.
        split: from observations ``[N, *obs]`` to the entries that it reads; by default all is ``observation``.
    """

    def __init__(self, policy: torch.nn.Module, split: Callable[[torch.Tensor], Entries] | None = None) -> None:
        self.policy, self.split = policy, split or (lambda obs: {"observation": obs})
        self.size = next((int(part.state_size) for part in policy.modules() if hasattr(part, "state_size")), 0)
        self.state: torch.Tensor | None = None

    def __call__(self, obs: np.ndarray, fresh: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """Actions ``[N, *action]`` for ``obs [N, *obs]``; ``fresh [N]``: an episode begins here."""
        return self.on(self.split(torch.as_tensor(obs)), fresh, deterministic)

    def on(self, entries: Entries, fresh: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """The same for entries as the policy reads them."""
        device = next((p.device for p in self.policy.parameters()), torch.device("cpu"))
        batch = TensorDict(dict(entries), [len(fresh)]).to(device)
        if self.size:
            batch["is_init"] = torch.as_tensor(fresh, device=device).unsqueeze(-1)
            start = torch.zeros(len(fresh), self.size, device=device)
            batch["recurrent_state"] = start if self.state is None else self.state
        kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        with torch.no_grad(), set_exploration_type(kind):
            out = self.policy(batch)
        self.state = out.get(("next", "recurrent_state"), None)
        return out["action"].cpu().numpy()


def act(policy: torch.nn.Module, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
    """Actions ``[N, *action]`` for the first observations of episodes, ``[N, *obs]``, without gradients."""
    return Acting(policy)(obs, np.ones(len(obs), bool), deterministic)


def check_playable(env: Any) -> None:
    """A ``UserError`` for an environment that :func:`play` cannot step."""
    if isinstance(env, TransformedEnv) or not hasattr(env, "arrays"):  # the former's arrays know no transforms
        raise UserError(
            f"evaluation plays what envs.make gives, a {type(env).__name__} is none of that: "
            "use env.rollout(steps, actor)"
        )


def play(policy: Any, env: Any, episodes: int, deterministic: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Returns and lengths of ``episodes`` whole episodes, each ``[episodes]``, ordered by env slot.

    Every one of the env's N slots plays its own share (``episodes / N``) to the end: to take whichever
    episodes finish first would favour the short ones. The global random state and the policy's mode are kept.

    Args:
        policy: a TensorDict actor that reads ``observation`` and writes ``action``, or what ``load_policy`` gives.
        env: has ``.arrays``: ``reset()``, ``step(action)``, ``obs``, ``episode_reward``, ``step_count``.
        deterministic: the likeliest actions, or draws.
    """
    check_whole_number(1, episodes=episodes)
    check_playable(env)
    policy = policy if isinstance(policy, torch.nn.Module) else policy.actor
    arrays, act = env.arrays, Acting(policy, getattr(env, "split", None))
    with preserved_rng(), _evaluating(policy):
        obs = arrays.reset()
        slots = len(obs)
        share = [episodes // slots + (slot < episodes % slots) for slot in range(slots)]
        fresh = np.ones(slots, bool)
        finished: list[list[tuple[float, int]]] = [[] for _ in range(slots)]
        while any(len(done) < wanted for done, wanted in zip(finished, share, strict=True)):
            _, _, terminated, truncated = arrays.step(act(arrays.obs, fresh, deterministic))
            fresh = terminated | truncated
            if (arrays.step_count[~fresh] == LONG_EPISODE).any():
                getLogger("pgkit").warning(
                    "an episode of evaluation has come to %s steps and goes on: does the environment end? "
                    "envs.make(id, max_episode_steps=...) sets a time limit", f"{LONG_EPISODE:,}",
                )  # fmt: skip
            for slot in np.flatnonzero(fresh):
                if len(finished[slot]) < share[slot]:
                    finished[slot].append((float(arrays.episode_reward[slot]), int(arrays.step_count[slot])))
    flat = [episode for slot in finished for episode in slot]
    return np.array([reward for reward, _ in flat]), np.array([length for _, length in flat])


def evaluate(policy: Any, env: Any, episodes: int, deterministic: bool = True) -> dict[str, float]:
    """``eval/mean_reward``, ``eval/std_reward`` (population) and ``eval/mean_ep_length`` of :func:`play`."""
    rewards, lengths = play(policy, env, episodes, deterministic)
    return {
        "eval/mean_reward": float(rewards.mean()),
        "eval/std_reward": float(rewards.std()),
        "eval/mean_ep_length": float(lengths.mean()),
    }
