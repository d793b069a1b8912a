"""A replay buffer whose hot path is slices and indices of tensors: no TensorDict work a frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from logging import getLogger
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorStorage
from torchrl.envs import EnvBase

from pgkit.data import files
from pgkit.data.gather import Gather, gather
from pgkit.data.prioritized import Prioritized
from pgkit.errors import UserError, check_whole_number


class ReplayBuffer:
    """The last ``capacity`` frames of ``env``, on TorchRL's storages.

    :meth:`extend` writes a rollout ``[num_envs, T]`` by slices, :meth:`sample_index` draws the row numbers of many
    batches at once, and the update gathers the rows inside its compiled step. An observation is stored once: frames lie
    in time order with ``num_envs`` columns, so the next observation of row ``i`` is the observation of row
    ``i + num_envs``; final observations of episodes lie in a table of their own. Where that table is too small (an
    ending for every 8 frames, by default) the oldest frames leave early; none is ever wrong.

    Args:
        env: shapes, dtypes and the number of columns come from its specs.
        capacity: frames to keep.
        n_steps: length of the returns: a sample's reward is the discounted sum of up to so many rewards, cut at the
            end of an episode; ``steps_to_next_obs`` has the number of them. The discount is the loss's.
        sampler: :class:`~pgkit.data.Prioritized`; None draws uniformly.
        storage: makes a TorchRL storage of so many rows, e.g. :func:`~pgkit.data.in_files` for a
            buffer beyond RAM.
        final_rows: final observations to keep; by default an eighth of the capacity.
        entries: further entries of the rollouts to keep, with an example of one frame's: ``{"action_log_prob":
            torch.zeros(())}``. They come back in every batch.
        seed: of the draws; by default drawn from torch's global generator.
    """

    def __init__(
        self,
        env: EnvBase,
        capacity: int = 1_000_000,
        *,
        n_steps: int = 1,
        sampler: Prioritized | None = None,
        storage: Callable[[int], TensorStorage] = LazyTensorStorage,
        final_rows: int | None = None,
        entries: Mapping[str, Tensor] | None = None,
        seed: int | None = None,
    ) -> None:
        if not isinstance(env, EnvBase):
            raise UserError(f"ReplayBuffer(env, capacity): env is a {type(env).__name__}, give what envs.make gives")
        if sampler is not None and (isinstance(sampler, type) or not hasattr(sampler, "write_back")):
            raise UserError(f"sampler={sampler!r}: give data.Prioritized(), or None to draw uniformly")
        check_whole_number(1, capacity=capacity, n_steps=n_steps, final_rows=final_rows)
        self.columns = env.batch_size.numel()
        if capacity < self.columns:
            raise UserError(
                f"a replay buffer of capacity {capacity} does not hold one frame of each of the {self.columns} "
                "environments: raise the capacity"
            )
        self.capacity, self.n_steps, self.sampler = capacity, n_steps, sampler
        self.rows = (-(-capacity // self.columns) + 1) * self.columns  # one more step: the newest next observations
        self.final_rows = final_rows or max(capacity // 8, self.columns)
        self.env_name = str(vars(env).get("env_id", type(env).__name__))
        spec, action = env.observation_spec_unbatched, env.action_spec_unbatched
        self.observation_keys = [key for key in spec.keys(True, True) if isinstance(spec[key].zero(), Tensor)]
        flag = torch.zeros(1, dtype=torch.bool)
        frame = {
            "action": action.zero(),
            "reward": torch.zeros(1),
            "terminated": flag,
            "done": flag,
            "next_row": torch.zeros((), dtype=torch.int32 if self.rows + self.final_rows < 2**31 else torch.int64),
        }
        observation = {key: spec[key].zero() for key in self.observation_keys}
        self.entries = list(entries or ())
        if twice := [key for key in self.entries if key in frame or key in observation]:
            raise UserError(f"entries={self.entries}: '{twice[0]}' is kept anyway, leave it out")
        frame |= entries or {}
        frames = _allocate(storage, frame, self.rows)
        observations = _allocate(storage, observation, self.rows + self.final_rows)
        self.frames, self.observations = dict(frames.items()), dict(observations.items(True, True))
        tables: dict[str, Any] = {"frames": frames, "observations": observations}
        if sampler is not None:
            tables["weighting"] = sampler.begin(self.rows)
        self.data = TensorDict(tables)
        self.written = self.start = self.finals = 0  # frames ever, the oldest one kept, final observations ever
        self.owner = torch.full((self.final_rows,), -1, dtype=torch.int64)  # frame each final observation belongs to
        self._warned = False
        self.generator = torch.Generator().manual_seed(int(torch.randint(2**62, ())) if seed is None else seed)

    def __len__(self) -> int:
        """Frames that can be sampled now."""
        return max(self.written - (self.n_steps - 1) * self.columns - self.start, 0)

    @torch.no_grad()
    def extend(self, rollout: TensorDictBase) -> None:
        """Writes a rollout ``[num_envs, T]`` (or ``[num_envs]``: one step) with TorchRL's ``next`` entries.

        Rollouts need not continue one another: where an observation is not the one that the frame before led to,
        that frame keeps its own.
        """
        if rollout.batch_size.numel() % self.columns or (self.columns > 1 and rollout.batch_size[0] != self.columns):
            raise UserError(
                f"the replay buffer was made for {self.columns} environments, the rollout's batch size is "
                f"{tuple(rollout.batch_size)}: it must be [{self.columns}, T]"
            )
        columns, dims, after = self.columns, rollout.batch_dims, rollout.get("next", None)
        if after is None:
            raise UserError(
                "the rollout to store has no 'next': give next.observation, next.reward, next.terminated, ..."
            )
        steps = rollout.batch_size.numel() // columns
        most = self.rows // columns - 1

        def rows_of(data: TensorDictBase, key: Any) -> Tensor:  # [T * columns, ...], in time order
            x = data.get(key, None)
            if x is None:
                where = "next" if data is after else "rollout"
                raise UserError(f"the {where} to store has no '{key}', only {', '.join(map(str, data.keys()))}")
            if key in self.observation_keys:
                x = x.to(self.observations[key].dtype)
            if steps == 1:
                return x.reshape(columns, *x.shape[dims:])
            x = x.reshape(columns, steps, *x.shape[dims:]).transpose(0, 1)
            return x[-most:].reshape(-1, *x.shape[2:])

        obs = {key: rows_of(rollout, key) for key in self.observation_keys}
        next_obs = {key: rows_of(after, key) for key in self.observation_keys}
        done = rows_of(after, "done")
        first, count, oldest, ready = self.written, done.shape[0], self.start, self.start + len(self)
        if first > self.start:
            self._keep_ends(first, {key: x[:columns] for key, x in obs.items()})
        rows = torch.arange(first, first + count + columns) % self.rows
        self.written += count
        self.start = max(self.start, self.written - (self.rows - columns))

        for key, x in obs.items():
            _write(self.observations[key], self.rows, first, x)
            _write(self.observations[key], self.rows, first + count, next_obs[key][count - columns :])
        for key, x in {
            "action": rows_of(rollout, "action"),
            "reward": rows_of(after, "reward"),
            "terminated": rows_of(after, "terminated"),
            "done": done,
            "next_row": rows[columns:],
            **{key: rows_of(rollout, key) for key in self.entries},
        }.items():
            _write(self.frames[key], self.rows, first, x)

        ends = done.squeeze(-1)
        if steps > 1:
            ends = ends.clone()
            for key, x in obs.items():
                ends[:-columns] |= _differ(next_obs[key][:-columns], x[columns:])
        if ends.any():
            where = ends.nonzero().squeeze(-1)
            self._keep_finals(first + where, {key: x[where] for key, x in next_obs.items()})
        if self.sampler is not None:
            new = torch.arange(max(ready, self.start), self.start + len(self))
            self.sampler.extend(new % self.rows, torch.arange(oldest, self.start) % self.rows)

    def sample_index(self, batch_size: int, batches: int = 1) -> Tensor:
        """Row numbers ``[batches, batch_size]``, drawn with replacement.

        Raises:
            UserError: fewer frames are stored than a batch has.
        """
        if batch_size > len(self):
            raise UserError(
                f"batch_size={batch_size} is above the {len(self)} frames stored: collect more frames first"
            )
        if self.sampler is not None:
            return self.sampler.sample(batches, batch_size, self.generator)
        return (torch.randint(len(self), (batches, batch_size), generator=self.generator) + self.start) % self.rows

    def sample(self, batch_size: int, gamma: float | Tensor = 1.0) -> TensorDictBase:
        """A batch ``[batch_size]`` of transitions with TorchRL's keys; ``gamma`` counts where ``n_steps > 1``."""
        return self.gather(gamma)(self.data, self.sample_index(batch_size)[0])

    def write_back(self, data: TensorDictBase, index: Tensor, batch: TensorDictBase) -> None:
        """Makes the ``td_error`` of a batch the priorities of its rows, where the draws are prioritized."""
        if self.sampler is not None:
            self.sampler.write_back(index, batch["td_error"].flatten())

    def gather(self, gamma: float | Tensor) -> Gather:
        """``(data, index) -> batch`` of :attr:`data`, a function of tensors that can be compiled."""
        return partial(gather, rows=self.rows, n_steps=self.n_steps, gamma=gamma)

    def clear(self) -> None:
        """Forgets every frame."""
        if self.sampler is not None:
            self.sampler.extend(torch.arange(0), torch.arange(self.rows))
        self.written = self.start = self.finals = 0
        self.owner.fill_(-1)

    def state_dict(self) -> dict[str, Any]:
        """Everything stored, and the state of the draws."""
        return files.state(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`; a ``UserError`` if it is of another environment or another size."""
        files.restore(self, state)

    def save(self, path: str | Path) -> None:
        """Writes :meth:`state_dict` to a file of its own, in one step."""
        files.save(self, Path(path))

    def load(self, path: str | Path) -> None:
        """Reads what :meth:`save` wrote."""
        files.load(self, Path(path))

    def _keep_ends(self, frame: int, obs: dict[Any, Tensor]) -> None:
        """Of the newest step so far: keeps the next observations that ``obs``, about to overwrite them, is not."""
        head, last = frame % self.rows, (frame - self.columns) % self.rows
        stored = {key: self.observations[key][head : head + self.columns] for key in obs}
        if all(torch.equal(stored[key], x) for key, x in obs.items()):
            return
        ends = torch.zeros(self.columns, dtype=torch.bool)
        for key, x in obs.items():
            ends |= _differ(stored[key], x)
        ends &= self.frames["next_row"][last : last + self.columns] < self.rows
        if ends.any():
            where = ends.nonzero().squeeze(-1)
            self._keep_finals(frame - self.columns + where, {key: x[where] for key, x in stored.items()})

    def _keep_finals(self, frames: Tensor, obs: dict[Any, Tensor]) -> None:
        for part in torch.arange(len(frames)).split(self.final_rows):
            slots = (self.finals + torch.arange(len(part))) % self.final_rows
            oldest = int(self.owner[slots].max()) + 1
            if oldest > self.start and not self._warned:
                self._warned = True
                getLogger("pgkit").warning(
                    "episodes end, or frames do not continue one another, more often than the replay has room for "
                    "final observations (%d): old frames leave before there are %d; ReplayBuffer(final_rows=...) is "
                    "that room, as large as the capacity for frames in no order",
                    self.final_rows, self.capacity,
                )  # fmt: skip
            self.start = max(self.start, oldest)
            self.owner[slots] = frames[part]
            self.finals += len(part)
            self.frames["next_row"][frames[part] % self.rows] = (self.rows + slots).to(self.frames["next_row"].dtype)
            for key, x in obs.items():
                self.observations[key][self.rows + slots] = x[part]


def _differ(x: Tensor, y: Tensor) -> Tensor:
    """Which rows ``[rows, *shape]`` differ, ``[rows]``."""
    return (x != y).unsqueeze(-1).flatten(1).any(-1)


def _write(table: Tensor, rows: int, frame: int, x: Tensor) -> None:
    """Writes ``x`` into the ``rows`` first rows of a table, from row ``frame % rows`` on and around its end."""
    row, count = frame % rows, x.shape[0]
    room = min(rows - row, count)
    table.narrow(0, row, room).copy_(x if room == count else x[:room])
    if count > room:
        table.narrow(0, 0, count - room).copy_(x[room:])


def _allocate(storage: Callable[[int], TensorStorage], example: dict[Any, Tensor], rows: int) -> TensorDictBase:
    made, log = storage(rows), getLogger("torchrl")
    level = log.level
    log.setLevel("WARNING")  # TorchRL reports every allocation
    made.set(0, TensorDict(example))
    log.setLevel(level)
    return cast(TensorDictBase, made._storage)  # get() is limited to the rows that were set through the storage itself
