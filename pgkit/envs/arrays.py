"""The numpy side of a vector of environments: same-step autoreset, true final observations, exact replay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from pgkit.envs.checks import check_step, checked_reset
from pgkit.errors import UserError

_ARRAYS = (spaces.Box, spaces.MultiBinary)  # whose observations are arrays


def episode_seed(seed: int, index: int, episode: int) -> int:
    """Seed of one episode: a function of the run's seed, the environment's index and the episode's number."""
    return int(np.random.SeedSequence((seed, index, episode)).generate_state(1)[0])


class ArrayEnv:
    """``num_envs`` Gymnasium environments stepped in one process, float32 arrays in and out.

    An episode that ends is reset within the same step: :meth:`step` returns the true final observation and
    :attr:`obs` holds the first observation of the next episode. Every episode is seeded from
    ``(seed, index of the environment, number of the episode)``, so the state of a deterministic simulator is
    those numbers and the actions since: that is what :meth:`state_dict` stores and :meth:`load_state_dict`
    replays, bit for bit.

    Args:
        make_env: makes one environment.
        num_envs: how many of them, ``N`` below.
        seed: the run's seed.
        first: index of the first environment, where a worker holds a slice of a larger vector.

    Attributes:
        obs: ``[N, *obs]``, the observations to act on next.
        episode_reward: float64 ``[N]``, undiscounted return so far of the episode the last step belonged to.
        step_count: int64 ``[N]``, its length so far.
        fresh: bool ``[N]``, the episode was begun and has not been stepped since.
        memory: float32 ``[N, size]``, a recurrent policy's state, kept here so that it is saved with its episode; None
            for other policies.
    """

    def __init__(self, make_env: Callable[[], gym.Env], num_envs: int, seed: int = 0, first: int = 0) -> None:
        self.envs = [make_env() for _ in range(num_envs)]
        if len({id(env.unwrapped) for env in self.envs}) < num_envs:
            raise UserError("the function that makes an environment gave the same one twice: it must make a new one")
        self.num_envs, self.first = num_envs, first
        self._write, shape = _observation_writer(self.envs[0].observation_space)
        self._to_env = _action_converter(self.envs[0].action_space)
        self.obs = np.zeros((num_envs, *shape), np.float32)
        self._next_obs = np.zeros_like(self.obs)
        self._reward = np.zeros(num_envs, np.float32)
        self._terminated = np.zeros(num_envs, bool)
        self._truncated = np.zeros(num_envs, bool)
        self.memory: np.ndarray | None = None
        self._stepped = False
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Back to the state of a new object with this seed; :meth:`reset` begins the first episodes."""
        self.seed = seed
        self.episode_reward = np.zeros(self.num_envs)
        self.step_count = np.zeros(self.num_envs, np.int64)
        self.fresh = np.zeros(self.num_envs, bool)
        self._episode = np.full(self.num_envs, -1)
        self._taken: list[np.ndarray] = []  # actions [N, ...] of the last steps
        self._since = np.zeros(self.num_envs, np.int64)  # where in those each episode begins

    def _begin(self, i: int) -> None:
        self._episode[i] += 1
        seed = episode_seed(self.seed, self.first + i, int(self._episode[i]))
        result = self.envs[i].reset(seed=seed) if self._episode[i] else checked_reset(self.envs[i], seed)
        self._write(self.obs[i], result[0])
        self.fresh[i] = True
        self._since[i] = len(self._taken)
        oldest = int(self._since.min())
        if 2 * oldest > len(self._taken):  # more than half belongs to episodes that are over
            del self._taken[:oldest]
            self._since -= oldest

    def reset(self, mask: np.ndarray | None = None) -> np.ndarray:
        """Starts a new episode where ``mask`` (``[N]``, all by default) is set, unless one has just started."""
        for i in range(self.num_envs) if mask is None else np.flatnonzero(mask):
            if not self.fresh[i]:
                self._begin(i)
        return self.obs

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Steps every environment; Box actions are clipped to their bounds first.

        Returns ``next_obs [N, *obs]``, ``reward [N]``, ``terminated [N]``, ``truncated [N]``: the same arrays at
        every call, overwritten by the next.
        """
        if self.fresh.any():
            self.episode_reward[self.fresh] = 0.0
            self.step_count[self.fresh] = 0
            self.fresh[:] = False
        actions = self._to_env(actions)
        for i, env in enumerate(self.envs):
            result = env.step(actions[i])
            if not self._stepped:
                check_step(env, actions[i], result)
            obs, reward, terminated, truncated, _ = result
            self._write(self._next_obs[i], obs)
            self._reward[i], self._terminated[i], self._truncated[i] = reward, terminated, truncated
        self._taken.append(actions)
        self._stepped = True
        self.episode_reward += self._reward
        self.step_count += 1
        self.obs[:] = self._next_obs
        done = self._terminated | self._truncated
        if done.any():
            for i in np.flatnonzero(done):
                self._begin(i)
        return self._next_obs, self._reward, self._terminated, self._truncated

    def state_dict(self) -> dict[str, Any]:
        """Episode numbers and the actions taken since each episode began."""
        history = [np.array([actions[i] for actions in self._taken[since:]]) for i, since in enumerate(self._since)]
        state = {"seed": self.seed, "episode": self._episode.copy(), "history": history}
        return state if self.memory is None else state | {"memory": self.memory.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores every environment by replaying the actions of its current episode."""
        self.seed, self.memory, history = state["seed"], state.get("memory"), state["history"]
        for i, env in enumerate(self.envs):
            if state["episode"][i] < 0:  # taken before the first reset
                continue
            self._episode[i] = state["episode"][i] - 1
            self._begin(i)
            self.episode_reward[i], self.step_count[i] = 0.0, len(history[i])
            for action in history[i]:
                obs, reward, *_ = env.step(action)
                self._write(self.obs[i], obs)
                self.episode_reward[i] += np.float32(reward)
                self.fresh[i] = False
        longest = max(history, key=len)
        taken = np.zeros((len(longest), self.num_envs, *longest.shape[1:]), longest.dtype)
        self._since = np.array([len(longest) - len(actions) for actions in history])
        for i in range(self.num_envs):
            if len(history[i]):
                taken[self._since[i] :, i] = history[i]
        self._taken = list(taken)

    def close(self) -> None:
        for env in self.envs:
            env.close()


def observation_shape(space: gym.Space) -> tuple[int, ...]:
    """Shape of the float32 array an observation of ``space`` becomes: a Box keeps its own, all else is flattened."""
    if isinstance(space, spaces.Box):
        return space.shape or (1,)
    if not space.is_np_flattenable:
        raise UserError(f"the observation space {space} cannot become one vector: encode it in a wrapper")
    return (spaces.flatdim(space),)


def _observation_writer(space: gym.Space) -> tuple[Callable[[np.ndarray, Any], None], tuple[int, ...]]:
    """A function that writes one observation into its float32 row, and the row's shape."""
    shape = observation_shape(space)
    if isinstance(space, spaces.Box):

        def write(row: np.ndarray, obs: Any) -> None:
            row[...] = obs
    elif isinstance(space, spaces.Dict) and all(isinstance(s, _ARRAYS) for s in space.spaces.values()):
        ends = np.cumsum([int(np.prod(s.shape or 1)) for s in space.spaces.values()]).tolist()
        slices = [(k, slice(a, b)) for k, a, b in zip(space.spaces, [0, *ends], ends, strict=False)]

        def write(row: np.ndarray, obs: Any) -> None:
            for key, where in slices:
                row[where] = np.ravel(obs[key])
    else:

        def write(row: np.ndarray, obs: Any) -> None:
            row[...] = spaces.flatten(space, obs)

    return write, shape


def _action_converter(space: gym.Space) -> Callable[[np.ndarray], np.ndarray]:
    """A function from the policy's actions ``[N, ...]`` to what the environments accept."""
    if isinstance(space, spaces.Box):
        low, high = space.low, space.high
        nearest = np.rint if np.issubdtype(space.dtype, np.integer) else np.asarray
        return lambda actions: nearest(np.minimum(np.maximum(actions, low), high)).astype(space.dtype, copy=False)
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        start = space.start
        return (lambda actions: actions + start) if np.any(start) else np.array
    if isinstance(space, spaces.MultiBinary):
        return lambda actions: actions.astype(space.dtype)
    raise UserError(f"action space {space} is not supported: Box, Discrete, MultiDiscrete and MultiBinary are")
