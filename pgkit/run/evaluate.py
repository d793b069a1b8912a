"""Evaluation: whole episodes, deterministic actions, the same number from every env slot."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit.run.seeding import preserved_rng


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


def act(policy: torch.nn.Module, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
    """Actions ``[N, *action]`` for observations ``[N, *obs]``, without gradients."""
    device = next((p.device for p in policy.parameters()), torch.device("cpu"))
    batch = TensorDict({"observation": torch.as_tensor(obs, device=device)}, [len(obs)], device=device)
    kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    with torch.no_grad(), set_exploration_type(kind):
        return policy(batch)["action"].cpu().numpy()


def play(policy: torch.nn.Module, env: Any, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns and lengths of ``episodes`` whole episodes, each ``[episodes]``, ordered by env slot.

    Every one of the env's N slots plays its own share (``episodes / N``) to the end: to take whichever
    episodes finish first would favour the short ones. The global random state and the policy's mode are kept.

    Args:
        policy: a TensorDict actor that reads ``observation`` and writes ``action``.
        env: has ``.arrays``: ``reset()``, ``step(action)``, ``obs``, ``episode_reward``, ``step_count``.
    """
    arrays = env.arrays
    with preserved_rng(), _evaluating(policy):
        obs = arrays.reset()
        slots = len(obs)
        share = [episodes // slots + (slot < episodes % slots) for slot in range(slots)]
        finished: list[list[tuple[float, int]]] = [[] for _ in range(slots)]
        while any(len(done) < wanted for done, wanted in zip(finished, share, strict=True)):
            _, _, terminated, truncated = arrays.step(act(policy, arrays.obs))
            for slot in np.flatnonzero(terminated | truncated):
                if len(finished[slot]) < share[slot]:
                    finished[slot].append((float(arrays.episode_reward[slot]), int(arrays.step_count[slot])))
    flat = [episode for slot in finished for episode in slot]
    return np.array([reward for reward, _ in flat]), np.array([length for _, length in flat])


def evaluate(policy: torch.nn.Module, env: Any, episodes: int) -> dict[str, float]:
    """``eval/mean_reward``, ``eval/std_reward`` (population) and ``eval/mean_ep_length`` of :func:`play`."""
    rewards, lengths = play(policy, env, episodes)
    return {
        "eval/mean_reward": float(rewards.mean()),
        "eval/std_reward": float(rewards.std()),
        "eval/mean_ep_length": float(lengths.mean()),
    }
