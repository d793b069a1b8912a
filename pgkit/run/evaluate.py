"""Evaluation: whole episodes, deterministic actions, the same number from every env slot."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from logging import getLogger
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit.collectors.actor import path_of, state_of
from pgkit.envs import vector_of
from pgkit.errors import check_whole_number
from pgkit.run.seeding import preserved_rng
from pgkit.seams import Entries, Key

LONGEST = 100_000  # steps of an episode; longer than those of Gymnasium, dm_control and Atari


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
    """A policy that acts, with its memory where it is recurrent.

    Args:
        policy: a TensorDict actor.
        keys: of its actions.
    """

    def __init__(self, policy: torch.nn.Module, keys: tuple[Key, ...] = ("action",)) -> None:
        self.policy, self.keys = policy, keys
        self.memory = state_of(policy)
        self.device = next((x.device for x in (*policy.parameters(), *policy.buffers())), None)
        self.state: Tensor | None = None

    def __call__(self, entries: Mapping[Key, Tensor], begun: Tensor, deterministic: bool = True) -> Entries:
        """Actions ``[N, ...]`` by key for the entries ``[N, ...]`` that it reads; ``begun [N]``: an episode begins."""
        batch = TensorDict(dict(entries), [len(begun)]).to(self.device)
        if self.memory is not None:
            key, shape = self.memory
            batch["is_init"] = begun.unsqueeze(-1).to(self.device)
            start = torch.zeros(len(begun), *shape, device=self.device)
            batch[key] = start if self.state is None else self.state
        kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        with torch.no_grad(), set_exploration_type(kind):
            out = self.policy(batch)
        self.state = None if self.memory is None else out.get(("next", *path_of(self.memory[0])), None)
        return {key: out[key] for key in self.keys}


def act(policy: torch.nn.Module, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
    """Actions ``[N, *action]`` for the first observations of episodes, ``[N, *obs]``, without gradients."""
    begun = torch.ones(len(obs), dtype=torch.bool)
    return Acting(policy)({"observation": torch.as_tensor(obs)}, begun, deterministic)["action"].cpu().numpy()


def play(
    policy: Any, env: Any, episodes: int, deterministic: bool = True, longest: int = LONGEST
) -> tuple[np.ndarray, np.ndarray]:
    """Returns and lengths of ``episodes`` whole episodes, each ``[episodes]``, ordered by env slot.

    Every one of the env's N slots plays its own share (``episodes / N``) to the end: to take whichever
    episodes finish first would favour the short ones. The global random state and the policy's mode are kept. Of
    several agents, the return is their mean.

    Args:
        policy: a TensorDict actor, or what ``load_policy`` gives.
        env: from ``envs.make``, or any TorchRL environment that it takes.
        deterministic: the likeliest actions, or draws.
        longest: an episode ends after so many steps, counts as it is, and a warning says so.
    """
    check_whole_number(1, episodes=episodes, longest=longest)
    env = vector_of(env)
    policy = policy if isinstance(policy, torch.nn.Module) else policy.actor
    with preserved_rng(), _evaluating(policy):
        simulator, act = env.simulator, Acting(policy, tuple(env.action_keys))
        fresh, slots = simulator.reset(), simulator.num_envs
        share = [episodes // slots + (slot < episodes % slots) for slot in range(slots)]
        begun = torch.ones(slots, dtype=torch.bool, device=simulator.device)
        finished: list[list[tuple[float, int]]] = [[] for _ in range(slots)]
        while any(len(done) < wanted for done, wanted in zip(finished, share, strict=True)):
            actions = {key: x.to(simulator.device) for key, x in act(fresh, begun, deterministic).items()}
            step = simulator.step(actions)
            ended, begun, fresh = step.ended(), step.begun().clone(), step.fresh
            endless = ~ended & (simulator.step_count >= longest)
            if endless.any():
                _warn_of_length(longest)
            ended = ended | endless
            if ended.any():
                totals = [x.flatten(1).double() for x in simulator.episode_reward.values()]
                returns = torch.cat(totals, 1).mean(1)
                for slot in ended.nonzero().flatten().tolist():
                    if len(finished[slot]) < share[slot]:
                        finished[slot].append((float(returns[slot]), int(simulator.step_count[slot])))
            if endless.any():
                fresh, begun = simulator.reset(rows=endless), begun | endless
    flat = [episode for slot in finished for episode in slot]
    return np.array([reward for reward, _ in flat]), np.array([length for _, length in flat])


def _warn_of_length(longest: int) -> None:
    getLogger("pgkit").warning(
        "an episode of evaluation was ended at %s steps and counts as it is: does the environment end? "
        "envs.make(id, max_episode_steps=...) sets a time limit", f"{longest:,}",
    )  # fmt: skip


def evaluate(policy: Any, env: Any, episodes: int, deterministic: bool = True) -> dict[str, float]:
    """``eval/mean_reward``, ``eval/std_reward`` (population) and ``eval/mean_ep_length`` of :func:`play`."""
    rewards, lengths = play(policy, env, episodes, deterministic)
    return {
        "eval/mean_reward": float(rewards.mean()),
        "eval/std_reward": float(rewards.std()),
        "eval/mean_ep_length": float(lengths.mean()),
    }
