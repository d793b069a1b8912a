"""Prompts as the evaluation of today steps them, in NumPy; it goes when evaluation steps any Simulator."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch


class PromptArrays:
    """``arrays`` of an environment of prompts: one-step episodes."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def reset(self) -> np.ndarray:
        self.obs = self.env.reset()["observation"].cpu().numpy()
        return self.obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        step = self.env.step({"action": torch.as_tensor(action, device=self.env.device)})
        self.obs = step.fresh["observation"].cpu().numpy()
        self.episode_reward = step.reward["reward"].squeeze(-1).cpu().numpy()
        self.step_count = np.ones(len(self.obs), dtype=np.int64)
        ended = np.ones(len(self.obs), dtype=bool)
        return self.obs, self.episode_reward, ended, ~ended
