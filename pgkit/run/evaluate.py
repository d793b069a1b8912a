"""Evaluation: whole episodes, deterministic actions, the same number from every env slot."""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from logging import WARNING, getLogger
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit.collectors.actor import path_of, state_of
from pgkit.collectors.policy import Act, trace
from pgkit.compiled import Constants
from pgkit.envs import vector_of
from pgkit.errors import check_whole_number
from pgkit.functional.modes import in_evaluation
from pgkit.run.seeding import preserved_rng
from pgkit.seams import Entries, Key

RECORDED_AT, MOST_RECORDS = 20, 8  # calls of one layout before it is recorded, which takes 0.1 s; layouts
LONGEST = 100_000  # steps of an episode; longer than those of Gymnasium, dm_control and Atari


@contextmanager
def _without_infos() -> Iterator[None]:
    """What can be recorded is said where the policy is trained."""
    log = getLogger("pgkit")
    level = log.level
    log.setLevel(WARNING)
    try:
        yield
    finally:
        log.setLevel(level)


@contextmanager
def _one_thread() -> Iterator[None]:
    """For a few rows a second thread costs more than it brings."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class Acting:
    """A policy that acts, in evaluation mode, with its memory where it is recurrent.

    From the 20th call for as many rows on, the policy's tensor operations are called without TensorDict: the same
    numbers, several times faster. What changes in the policy is noticed.

    Args:
        policy: a TensorDict actor.
        keys: of its actions.
    """

    def __init__(self, policy: torch.nn.Module, keys: tuple[Key, ...] = ("action",)) -> None:
        self.policy, self.keys = policy, keys
        self.memory = state_of(policy)
        self.device = next((x.device for x in (*policy.parameters(), *policy.buffers())), None)
        self.state: Tensor | None = None
        self._calls = Counter[Any]()  # by layout and kind
        self._recorded: dict[Any, Act] = {}
        self._constants: Constants | None = None

    def __call__(self, entries: Mapping[Key, Tensor], begun: Tensor, deterministic: bool = True) -> Entries:
        """Actions ``[N, ...]`` by key for the entries ``[N, ...]`` that it reads; ``begun [N]``: an episode begins."""
        inputs: Entries = dict(entries)
        if self.memory is not None:
            key, shape = self.memory
            inputs["is_init"] = begun.unsqueeze(-1)
            kept = self.state is not None and not begun.all()
            inputs[key] = self.state if kept else torch.zeros(len(begun), *shape)
        if self.device is not None and self.device.type != "cpu":
            inputs = {key: x.to(self.device) for key, x in inputs.items()}
        with torch.no_grad():
            actions = self._act(inputs, deterministic)(*inputs.values())
        if self.memory is not None:
            *actions, self.state = actions
        return dict(zip(self.keys, actions, strict=True))

    def _act(self, inputs: Entries, deterministic: bool) -> Act:
        """The policy as a function of these entries' tensors."""
        if self._constants is not None and self._constants.changed(memory=False):
            self._recorded.clear()
            self._calls.clear()
            self._constants = None
        which = (deterministic, *[(key, x.shape) for key, x in inputs.items()])
        if which in self._recorded:
            return self._recorded[which]
        act = self._function(list(inputs), deterministic)
        self._calls[which] += 1
        if self._calls[which] < RECORDED_AT or len(self._recorded) == MOST_RECORDS:
            return act
        with torch.no_grad(), torch.random.fork_rng(), _without_infos():
            self._recorded[which] = trace(act, list(inputs.values()), self.policy)
        self._constants = Constants({"the policy": self.policy}, but={"training"})
        return self._recorded[which]

    def _function(self, keys: list[Key], deterministic: bool) -> Act:
        kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM

        def act(*inputs: Tensor) -> list[Tensor]:
            data = TensorDict(dict(zip(keys, inputs, strict=True)), inputs[0].shape[:1])
            with in_evaluation(self.policy), set_exploration_type(kind):
                out = self.policy(data)
            found = [out[key] for key in self.keys]
            return found if self.memory is None else [*found, out.get(("next", *path_of(self.memory[0])))]

        return act


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
    with preserved_rng(), in_evaluation(policy), _one_thread():
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
