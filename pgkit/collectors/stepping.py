"""The inner loop of collecting: policy, environments, arrays; no TensorDict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from pgkit.collectors.policy import STATE, Act, choices
from pgkit.envs import ArrayEnv, VectorEnv
from pgkit.errors import UserError

Arrays = dict[NestedKey, np.ndarray]


def allocate(steps: int, obs: np.ndarray, outputs: dict[NestedKey, Tensor]) -> Arrays:
    """Empty arrays ``[steps, N, ...]`` for a rollout; ``outputs`` are examples ``[N, ...]`` of the policy's results."""
    num_envs = len(obs)
    recurrent: Arrays = {}
    if STATE in outputs:
        recurrent["recurrent_state"] = np.empty((steps, *outputs[STATE].shape), np.float32)
        recurrent["is_init"] = np.empty((steps, num_envs, 1), bool)
        recurrent["next", "is_init"] = np.zeros((steps, num_envs, 1), bool)
    flag = {("next", key): np.empty((steps, num_envs, 1), bool) for key in ("terminated", "truncated")}
    return {
        "observation": np.empty((steps, *obs.shape), np.float32),
        **{key: np.empty((steps, *x.shape), x.numpy().dtype) for key, x in outputs.items()},
        **recurrent,
        ("next", "observation"): np.empty((steps, *obs.shape), np.float32),
        ("next", "reward"): np.empty((steps, num_envs, 1), np.float32),
        **flag,
        ("next", "episode_reward"): np.empty((steps, num_envs, 1), np.float32),
        ("next", "step_count"): np.empty((steps, num_envs, 1), np.int64),
    }


@torch.inference_mode()
def fill(arrays: Arrays, envs: ArrayEnv, act: Act, keys: Sequence[NestedKey], num_envs: int, seed: int) -> None:
    """Steps ``envs`` through ``arrays`` with the policy ``act``, writing the columns of these environments.

    The policy always sees all ``num_envs`` rows (those of other processes are zero) and all its random numbers
    follow from ``seed``, so the numbers do not depend on how many processes share the environments.
    """
    rows = slice(envs.first, envs.first + envs.num_envs)
    own: Arrays = {key: array[:, rows] for key, array in arrays.items()}
    results = [own[key] for key in keys]
    obs, next_obs = own["observation"], own["next", "observation"]
    reward, terminated = own["next", "reward"][..., 0], own["next", "terminated"][..., 0]
    truncated, episode_reward = own["next", "truncated"][..., 0], own["next", "episode_reward"][..., 0]
    step_count = own["next", "step_count"][..., 0]
    action = own["action"]
    padded = envs.obs if envs.num_envs == num_envs else np.zeros((num_envs, *envs.obs.shape[1:]), np.float32)
    policy_input = torch.from_numpy(padded)
    inputs = [policy_input]
    memory = _Memory(own, envs, num_envs, rows) if STATE in own else None
    if memory is not None:
        inputs += memory.inputs
    if (envs.step_count == 0).all():
        envs.reset()
    torch.default_generator.manual_seed(seed)  # torch.manual_seed costs 0.3 ms
    for t in range(len(obs)):
        if padded is not envs.obs:
            padded[rows] = envs.obs
        obs[t] = envs.obs
        if memory is not None:
            memory.recall(t)
        for result, output in zip(results, act(*inputs), strict=True):
            result[t] = output.numpy()[rows]
        next_obs[t], reward[t], terminated[t], truncated[t] = envs.step(action[t])
        episode_reward[t], step_count[t] = envs.episode_reward, envs.step_count
    if memory is not None:
        memory.keep()


class _Memory:
    """A recurrent policy's state, from step to step; it begins at zero where an episode does, by ``is_init``."""

    def __init__(self, own: Arrays, envs: ArrayEnv, num_envs: int, rows: slice) -> None:
        self.envs, self.rows = envs, rows
        self.is_init, self.states, self.next_states = own["is_init"][..., 0], own["recurrent_state"], own[STATE]
        size = self.states.shape[-1]
        if envs.memory is None:
            envs.memory = np.zeros((envs.num_envs, size), np.float32)
        self.all_init, self.all_states = np.zeros((num_envs, 1), bool), np.zeros((num_envs, size), np.float32)
        self.inputs = [torch.from_numpy(self.all_init), torch.from_numpy(self.all_states)]

    def recall(self, t: int) -> None:
        """Lays out and stores what the policy reads at step ``t``."""
        if t > 0:
            self.envs.memory = self.next_states[t - 1]
        self.is_init[t], self.states[t] = self.envs.fresh, self.envs.memory
        self.all_init[self.rows, 0], self.all_states[self.rows] = self.is_init[t], self.states[t]

    def keep(self) -> None:
        """After the last step."""
        self.envs.memory = self.next_states[-1].copy()


def _unchecked(entries: dict[Any, Any]) -> TensorDictBase:
    """A TensorDict of tensors ``[N, T, ...]``; checking each entry costs a tenth of a millisecond a rollout."""
    shape = next(iter(entries.values())).shape[:2]
    return TensorDict._new_unsafe(source=entries, batch_size=shape)


def as_rollout(arrays: Arrays, env: VectorEnv) -> TensorDictBase:
    """The arrays ``[T, N, ...]`` as a TensorDict ``[N, T]``, without a copy, and ``("next", "done")``."""
    tensors: dict[Any, Tensor] = {key: torch.from_numpy(array).transpose(0, 1) for key, array in arrays.items()}
    after = {key[1]: tensors.pop(key) for key in arrays if key[0] == "next"}
    nested = {key: tensors.pop(key) for key in list(tensors) if isinstance(key, tuple)}
    now = env.split(tensors.pop("observation")) | tensors
    after = env.split(after.pop("observation")) | after
    if "action_mask" in now and not all(x.any(-1).all() for x in choices(env.action_spec, now["action_mask"])):
        raise UserError("the environment's action_mask allows no action in some state: it must allow at least one")
    after["done"] = after["terminated"] | after["truncated"]
    rollout = _unchecked({**now, "next": _unchecked(after)})
    for key, tensor in nested.items():
        rollout.set(key, tensor)
    return rollout
