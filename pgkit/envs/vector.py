"""A simulator as a TorchRL environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite
from torchrl.envs import EnvBase

from pgkit.envs.numpy_entries import as_path
from pgkit.errors import UserError
from pgkit.seams import Entries, MakeSimulator, Simulator


class VectorEnv(EnvBase):
    """``num_envs`` environments with batch size ``[num_envs]`` and TorchRL's specs and keys.

    TorchRL's collectors step it through TensorDicts; pgkit's use :attr:`simulator`, or give each of ``workers``
    processes a share that ``make`` makes. ``env_id`` names what it is made of, where :func:`~pgkit.envs.make` made it.

    Args:
        make: makes a share of the environments; it is pickled where there are workers.
        num_envs: number of environments.
        seed: every environment's seed is derived from it.
        workers: processes that collect with this environment (1: the calling process).
        splits: whether ``make`` makes any share, and in other processes too.

    Attributes:
        groups: of every group of agents, by its path, the dimensions after the environments'.
        env_timeout, restart_workers: as :func:`~pgkit.envs.make` was told.
    """

    env_id: str = "unnamed environment"
    env_timeout: float | None = None
    restart_workers: bool = False

    def __init__(
        self, make: MakeSimulator, num_envs: int = 1, seed: int = 0, workers: int = 1, splits: bool = True
    ) -> None:
        probe = make(0, num_envs if workers == 1 else 1, seed)
        num_envs = probe.num_envs if workers == 1 else num_envs
        device = None if probe.device.type == "cpu" else probe.device
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.make, self.num_envs, self.seed, self.workers = make, num_envs, seed, workers
        self.to_env, self.resume, self.masks, self.splits = probe.to_env, probe.resume, probe.masks, splits
        self.observation_spec, self.action_spec, self.reward_spec, self.done_spec, self.info_spec = (
            spec if workers == 1 else _expand(spec, num_envs)
            for spec in (
                probe.observation_spec, probe.action_spec, probe.reward_spec, probe.done_spec, probe.info_spec,
            )
        )  # fmt: skip
        specs = (self.observation_spec, self.full_action_spec, self.full_reward_spec, self.full_done_spec)
        groups = [(as_path(key), spec[key]) for spec in specs for key in spec.keys(True)]
        self.groups = {path: group.shape[1:] for path, group in groups if isinstance(group, Composite)}
        self._simulator: Simulator | None = probe if workers == 1 else None
        if workers > 1:
            probe.close()

    @property
    def simulator(self) -> Simulator:
        """All environments in this process; made at first use where workers collect."""
        if self._simulator is None:
            self._simulator = self.make(0, self.num_envs, self.seed)
        return self._simulator

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        seed = kwargs.pop("seed", None)
        if given := [name for name, value in kwargs.items() if value is not None]:
            raise UserError(
                f"reset({given[0]}=...): the environments take a seed only; for every reset: "
                "envs.make(..., reset_options=)"
            )
        fresh = self.simulator.reset(seed, None if mask is None else mask.reshape(self.num_envs))
        return self._tensordict(fresh)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        step = self.simulator.step({key: tensordict.get(key) for key in self.action_keys})
        out = self._tensordict({**step.next, **step.reward, **step.terminated, **step.truncated})
        for (key, terminated), truncated in zip(step.terminated.items(), step.truncated.values(), strict=True):
            done = "done" if isinstance(key, str) else (*key[:-1], "done")
            out.set(done, terminated | truncated)
        return out

    def _tensordict(self, entries: Entries) -> TensorDictBase:
        out = TensorDict({}, batch_size=self.batch_size, device=self.device)
        for key, x in entries.items():
            out.set(key, x.clone())
        for path, shape in self.groups.items():
            if (group := out.get(path, None)) is not None:
                group.batch_size = (*self.batch_size, *shape)
        return out

    def _set_seed(self, seed: int | None) -> None:
        self.seed = 0 if seed is None else seed
        if self._simulator is not None:
            self._simulator.reset(self.seed)

    def close_simulator(self) -> None:
        """Closes the environments of this process; the next use makes them anew."""
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None

    def close(self, *, raise_if_closed: bool = True) -> None:
        self.close_simulator()
        super().close(raise_if_closed=raise_if_closed)


def _expand(spec: Composite, num_envs: int) -> Composite:
    """The spec of one environment for many."""
    return spec.expand(num_envs)
