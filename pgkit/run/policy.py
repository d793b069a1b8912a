"""A trained policy, loaded from a run directory, on plain NumPy."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from pgkit.errors import UserError
from pgkit.run import checkpoint
from pgkit.run.directory import read_config
from pgkit.run.evaluate import act

Which = Literal["best", "latest"]


@dataclass
class Policy:
    """A policy with its observation normalizer, and the env it was trained for.

    ``low`` and ``high`` are the action bounds ``[*action]``, None for discrete actions.
    """

    actor: torch.nn.Module
    make_env: Callable[..., Any]
    observation_shape: tuple[int, ...]
    low: np.ndarray | None
    high: np.ndarray | None
    frames: int = 0

    def predict(self, obs: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """Action for one observation ``[*obs]``, or actions ``[N, *action]`` for a batch ``[N, *obs]``.

        Continuous actions are clipped to the env's bounds. A wrong shape is a UserError.
        """
        obs = np.asarray(obs, dtype=np.float32)
        single = obs.shape == self.observation_shape
        if not single and obs.shape[1:] != self.observation_shape:
            want = list(self.observation_shape)
            raise UserError(
                f"predict got an observation of shape {list(obs.shape)}; the policy takes {want} or a batch"
            )
        action = act(self.actor, obs[None] if single else obs, deterministic)
        if self.low is not None and self.high is not None:
            action = np.clip(action, self.low, self.high)
        return action[0] if single else action


def describe_env(env: Any) -> dict[str, Any]:
    """What :class:`Policy` must know of an env: the observation's shape and the action's bounds."""
    space = env.action_spec_unbatched.space
    low, high = getattr(space, "low", None), getattr(space, "high", None)
    return {
        "observation_shape": tuple(env.observation_spec_unbatched["observation"].shape),
        "low": None if low is None else low.cpu().numpy(),
        "high": None if high is None else high.cpu().numpy(),
    }


def load_policy(run_dir: str | Path, which: Which = "best") -> Policy:
    """The policy of a run: ``best`` by ``eval/mean_reward``, or ``latest``. The recipe's file is not needed.

    It unpickles: open only run directories that you trust.
    """
    run_dir = Path(run_dir)
    read_config(run_dir)
    saved = checkpoint.load(run_dir / "checkpoints" / f"{which}.pt")
    policy = Policy(**checkpoint.load(run_dir / "checkpoints" / "policy.pt"), frames=saved["frames"])
    policy.actor.load_state_dict(saved["states"]["policy"])
    policy.actor.eval()
    return policy
