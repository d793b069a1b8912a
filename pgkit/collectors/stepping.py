"""The inner loop of collecting: policy, environments, arrays; no TensorDict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from pgkit.collectors.policy import Act
from pgkit.envs import ArrayEnv

Arrays = dict[NestedKey, np.ndarray]


def allocate(steps: int, obs: np.ndarray, outputs: dict[NestedKey, Tensor]) -> Arrays:
    """Empty arrays ``[steps, N, ...]`` for a rollout; ``outputs`` are examples ``[N, ...]`` of the policy's results."""
    num_envs = len(obs)
    flag = {("next", key): np.empty((steps, num_envs, 1), bool) for key in ("terminated", "truncated")}
    return {
        "observation": np.empty((steps, *obs.shape), np.float32),
        **{key: np.empty((steps, *x.shape), x.numpy().dtype) for key, x in outputs.items()},
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
    if (envs.step_count == 0).all():
        envs.reset()
    torch.default_generator.manual_seed(seed)  # torch.manual_seed costs 0.3 ms
    for t in range(len(obs)):
        if padded is not envs.obs:
            padded[rows] = envs.obs
        obs[t] = envs.obs
        for result, output in zip(results, act(policy_input), strict=True):
            result[t] = output.numpy()[rows]
        next_obs[t], reward[t], terminated[t], truncated[t] = envs.step(action[t])
        episode_reward[t], step_count[t] = envs.episode_reward, envs.step_count


def as_rollout(arrays: Arrays) -> TensorDictBase:
    """The arrays ``[T, N, ...]`` as a TensorDict ``[N, T]``, without a copy, and ``("next", "done")``."""
    tensors = {key: torch.from_numpy(array).transpose(0, 1) for key, array in arrays.items()}
    tensors["next", "done"] = tensors["next", "terminated"] | tensors["next", "truncated"]
    rollout = TensorDict({}, batch_size=tensors["next", "done"].shape[:2])
    for key, tensor in tensors.items():
        rollout.set(key, tensor)
    return rollout
