"""A vector of Gymnasium environments as a TorchRL environment."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from logging import getLogger
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from pgkit.envs.arrays import ArrayEnv, observation_shape
from pgkit.envs.layout import Layout, layout
from pgkit.errors import UserError


class VectorEnv(EnvBase):
    """``num_envs`` environments with batch size ``[num_envs]`` and TorchRL's specs and keys.

    ``env_id`` names what it is made of, where :func:`~pgkit.envs.make` made it.

    TorchRL's collectors step it through TensorDicts; :class:`pgkit.collectors.VectorCollector` uses
    :attr:`arrays`, the numpy side, or gives each of ``workers`` processes its share of the environments.

    Args:
        make_env: makes one environment; it is pickled where there are workers.
        num_envs: number of environments.
        seed: every episode's seed is derived from it.
        workers: processes that collect with this environment (1: the calling process).
        flatten: False keeps the entries of a Dict observation apart.

    Attributes:
        observation_shape: shape of one observation in :attr:`arrays`, where a Dict is always flat.
        split: from those to the entries of a TensorDict, ``{"observation": ...}`` or, not flattened, the Dict's own.
    """

    env_id: str = "unnamed environment"

    def __init__(
        self, make_env: Callable[[], gym.Env], num_envs: int = 1, seed: int = 0, workers: int = 1, flatten: bool = True
    ) -> None:
        super().__init__(device=None, batch_size=torch.Size([num_envs]))
        self.make_env, self.num_envs, self.seed, self.workers = make_env, num_envs, seed, workers
        probe = make_env()
        self.observation_shape = observation_shape(probe.observation_space)
        self.split: Layout | Callable[[Tensor], dict[str, Tensor]] = (
            whole if flatten else layout(probe.observation_space)
        )
        if isinstance(self.split, Layout):
            self.observation_spec = self.split.spec(num_envs)
        else:
            spec = Unbounded((num_envs, *self.observation_shape), dtype=torch.float32)
            self.observation_spec = Composite(observation=spec, shape=(num_envs,))
        if flatten and "action_mask" in getattr(probe.observation_space, "spaces", ()):
            getLogger("pgkit").warning(
                "the observation's action_mask is flattened with the rest and masks nothing: "
                "envs.make(..., flatten=False) keeps it apart"
            )
        self.action_spec = action_spec(probe.action_space, num_envs)
        self.action_start = getattr(probe.action_space, "start", 0)  # of Gymnasium's discrete spaces; the spec's is 0
        self.reward_spec = Unbounded((num_envs, 1), dtype=torch.float32)
        flag = Categorical(2, shape=(num_envs, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag, truncated=flag, shape=(num_envs,))
        probe.close()

    @cached_property
    def arrays(self) -> ArrayEnv:
        """The numpy side, made at first use."""
        return ArrayEnv(self.make_env, self.num_envs, self.seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        obs = self.arrays.reset(None if mask is None else mask.reshape(self.num_envs).numpy())
        return TensorDict(self.split(torch.from_numpy(obs.copy())), batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        next_obs, reward, terminated, truncated = self.arrays.step(tensordict["action"].numpy())
        return TensorDict(
            {
                **self.split(torch.from_numpy(next_obs.copy())),
                "reward": torch.from_numpy(reward.copy()).unsqueeze(-1),
                "terminated": torch.from_numpy(terminated.copy()).unsqueeze(-1),
                "truncated": torch.from_numpy(truncated.copy()).unsqueeze(-1),
                "done": torch.from_numpy(terminated | truncated).unsqueeze(-1),
            },
            batch_size=self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        self.seed = 0 if seed is None else seed
        if "arrays" in self.__dict__:
            self.arrays.restart(self.seed)

    def close_arrays(self) -> None:
        if "arrays" in self.__dict__:
            self.__dict__.pop("arrays").close()

    def close(self, *, raise_if_closed: bool = True) -> None:
        self.close_arrays()
        super().close(raise_if_closed=raise_if_closed)


def whole(obs: Tensor) -> dict[str, Tensor]:
    """An observation of one entry."""
    return {"observation": obs}


def action_spec(space: gym.Space, num_envs: int) -> TensorSpec:
    """TorchRL's spec of ``num_envs`` actions of a Gymnasium space: ``[num_envs, dim]``, discrete ``[num_envs]``."""
    if isinstance(space, spaces.Box):
        low, high = (torch.as_tensor(x, dtype=torch.float32) for x in (space.low, space.high))
        shape = (num_envs, *space.shape)
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            return Unbounded(shape, dtype=torch.float32)
        return Bounded(low.expand(shape), high.expand(shape), shape, dtype=torch.float32)
    if isinstance(space, spaces.Discrete):
        return Categorical(int(space.n), shape=(num_envs,))
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary) and len(space.shape) != 1:
        raise UserError(
            f"the action space, {type(space).__name__}, has shape {space.shape}, actions are vectors: flatten it"
        )
    if isinstance(space, spaces.MultiDiscrete):
        return MultiCategorical(space.nvec.tolist(), shape=(num_envs, len(space.nvec)))
    if isinstance(space, spaces.MultiBinary):
        return MultiCategorical([2] * space.shape[0], shape=(num_envs, space.shape[0]))
    raise UserError(f"action space {space} is not supported: Box, Discrete, MultiDiscrete and MultiBinary are")
