"""Frames in time order: a ring of rows with a column for each environment, and a table of what the ring has not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from logging import getLogger
from typing import Any, TypeAlias, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorStorage

from pgkit.data import stacks
from pgkit.data.memory import check_fits
from pgkit.seams import Entries, Key

Storage: TypeAlias = Callable[[int], TensorStorage]


class Table:
    """The last ``steps`` steps of ``columns`` environments; every observation is stored once.

    Row ``i`` is followed by row ``i + columns``, so its next observation is the observation there. Where it is not (an
    episode ended, or another rollout was stored), the next observation has a row of its own after the ring's, one of
    ``final_rows``, and ``next_row`` points there. When those run out, the oldest frames leave: none is ever wrong.

    An observation that stacks ``k`` frames keeps its newest frame alone, and ``older`` points to the rows of the
    others: rows of the ring, or rows after it for a stack that began before the rollout did.

    Args:
        observation: an example of each observation, without batch dimensions.
        frame: an example of every other entry of a frame.
        capacity: frames to keep.
        columns: number of environments.
        final_rows: rows after the ring's.
        stacked: how many frames an observation stacks along its first dimension, the newest last; others are whole.
        storage: makes a TorchRL storage of so many rows; None: in the memory of ``device``, if they fit there.
        device: of the tables, where ``storage`` does not say.

    Attributes:
        rows: rows of the ring.
        frames: what was stored of each frame but its observations, ``[rows, ...]``.
        observations: their newest frames, ``[rows + final_rows, ...]``.
        written: frames ever written.
        start: the oldest frame that is kept, counted as ``written`` is.
    """

    def __init__(
        self, observation: Entries, frame: dict[str, Tensor], *, capacity: int, columns: int, final_rows: int,
        stacked: Mapping[Key, int], storage: Storage | None, device: torch.device,
    ) -> None:  # fmt: skip
        self.columns, self.final_rows, self.stacked = columns, final_rows, dict(stacked)
        self.steps, self.depth = -(-capacity // columns), max(stacked.values(), default=1) - 1
        self.rows = (self.steps + 1 + self.depth) * columns  # besides: the newest next observations, the oldest stacks
        number = torch.int32 if self.rows + final_rows < 2**31 else torch.int64
        frame = {**frame, "next_row": torch.zeros((), dtype=number)}
        if self.depth:
            frame["older"] = torch.zeros(self.depth, dtype=number)
        newest = {key: x[0] for key, x in self._newest({key: x[None] for key, x in observation.items()}).items()}
        if storage is None:
            sizes = [(frame, self.rows), (newest, self.rows + final_rows)]
            check_fits(capacity, {key: (x, rows) for table, rows in sizes for key, x in table.items()}, device)
            storage = partial(LazyTensorStorage, device=device)
        frames, observations = _allocate(storage, frame, self.rows), _allocate(storage, newest, self.rows + final_rows)
        self.data = TensorDict({"frames": frames, "observations": observations})
        self.frames: dict[str, Tensor] = dict(frames.items())
        self.observations: Entries = dict(observations.items(True, True))
        self.owner = torch.full((final_rows,), -1, dtype=torch.int64)  # the newest frame that needs a final row
        self.written = self.start = self.finals = 0
        self._warned = False

    @torch.no_grad()
    def write(self, obs: Entries, next_obs: Entries, frame: dict[str, Tensor]) -> None:
        """Writes rows in time order, ``[T * columns, ...]`` each, of as many steps as the ring has room for."""
        columns, first, count = self.columns, self.written, len(frame["done"])
        rows = torch.arange(first, first + count + columns) % self.rows
        ends = frame["done"].flatten(1).any(1).cpu()
        for key, x in obs.items():
            ends[:-columns] |= differ(next_obs[key][:-columns], x[columns:]).cpu()
        if self.depth:
            frame = {**frame, "older": self._older(first, rows[:count], obs)}
        obs, next_obs = self._newest(obs), self._newest(next_obs)
        if first > self.start:
            self._keep_ends(first, {key: x[:columns] for key, x in obs.items()})
        self.written += count
        self.start = max(self.start, self.written - self.steps * columns)
        for key, x in obs.items():
            self._put(self.observations[key], first, x)
            self._put(self.observations[key], first + count, next_obs[key][count - columns :])
        for key, x in {**frame, "next_row": rows[columns:]}.items():
            self._put(self.frames[key], first, x)
        if ends.any():
            where = ends.nonzero().squeeze(-1)
            self._keep_finals(first + where, {key: x[where] for key, x in next_obs.items()})

    def clear(self) -> None:
        """Forgets every frame."""
        self.written = self.start = self.finals = 0
        self.owner.fill_(-1)

    def state_dict(self) -> dict[str, Any]:
        """The rows in use and the counters."""
        frames, finals = min(self.written + self.columns, self.rows), min(self.finals, self.final_rows)
        return {
            "counters": (self.written, self.start, self.finals),
            "owner": self.owner[:finals].clone(),
            "frames": {key: x[:frames].clone() for key, x in self.frames.items()},
            "observations": {key: x[:frames].clone() for key, x in self.observations.items()},
            "finals": {key: x[self.rows :][:finals].clone() for key, x in self.observations.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict` into a table made alike."""
        self.clear()
        self.owner[: len(state["owner"])] = state["owner"]
        for key, x in state["frames"].items():
            self.frames[key][: len(x)] = x
        for key, x in state["observations"].items():
            self.observations[key][: len(x)] = x
        for key, x in state["finals"].items():
            self.observations[key][self.rows : self.rows + len(x)] = x
        self.written, self.start, self.finals = state["counters"]

    def _newest(self, obs: Entries) -> Entries:
        return {key: stacks.newest(x, self.stacked.get(key, 1)) for key, x in obs.items()}

    def _put(self, table: Tensor, frame: int, x: Tensor) -> None:
        """Writes ``x`` into a table from the row of ``frame`` on and around the ring's end."""
        row, count = frame % self.rows, x.shape[0]
        room = min(self.rows - row, count)
        table.narrow(0, row, room).copy_(x if room == count else x[:room])
        if count > room:
            table.narrow(0, 0, count - room).copy_(x[room:])

    def _older(self, first: int, rows: Tensor, obs: Entries) -> Tensor:
        """The rows of each stack's older frames, ``[T * columns, depth]``; the newest are about to go to ``rows``."""
        last = torch.arange(first - self.columns, first) % self.rows
        before = last.unsqueeze(1).repeat(1, self.depth + 1)
        begins = torch.zeros(len(rows), dtype=torch.bool)
        if first > self.start:
            before[:, :-1] = self.frames["older"][last].cpu()
        else:  # nothing is kept of the step before
            begins[: self.columns] = True
        for key, k in self.stacked.items():
            stack = stacks.gather(self.observations[key], before[:, -k:])
            begins |= stacks.begins(torch.cat([stack, obs[key][: -self.columns]]), obs[key], k).cpu()
        own = rows.unsqueeze(1).repeat(1, self.depth + 1)  # an episode's first frame stands for those before it
        where = begins.nonzero().squeeze(1)
        for key, k in self.stacked.items():
            where = where[~stacks.repeats(obs[key][where], k).cpu()]
        if len(where):  # a rollout from the middle of an episode
            older = {key: stacks.older(obs[key][where], k, self.depth) for key, k in self.stacked.items()}
            owners = first + where.unsqueeze(1) + self.columns * torch.arange(self.depth)
            own[where, :-1] = self._keep(owners.flatten(), older).view(-1, self.depth)
        return stacks.pointers(before, own, begins, self.columns)

    def _keep_ends(self, frame: int, obs: Entries) -> None:
        """Of the newest step so far: keeps the next observations that ``obs``, about to overwrite them, is not."""
        head, last = frame % self.rows, (frame - self.columns) % self.rows
        stored = {key: self.observations[key][head : head + self.columns] for key in obs}
        ends = torch.zeros(self.columns, dtype=torch.bool)
        for key, x in obs.items():
            ends |= differ(stored[key], x).cpu()
        if ends.any():
            ends &= (self.frames["next_row"][last : last + self.columns] < self.rows).cpu()
        if ends.any():
            where = ends.nonzero().squeeze(-1)
            self._keep_finals(frame - self.columns + where, {key: x[where] for key, x in stored.items()})

    def _keep_finals(self, frames: Tensor, obs: Entries) -> None:
        """Stores the next observations of ``frames`` in rows of their own."""
        rows, next_row = self._keep(frames, obs), self.frames["next_row"]
        next_row[frames % self.rows] = rows.to(next_row)

    def _keep(self, owners: Tensor, obs: Entries) -> Tensor:
        """Stores observations after the ring, until ``owners``, the newest frames that need them, leave; their rows."""
        rows = []
        for part in torch.arange(len(owners)).split(self.final_rows):
            slots = (self.finals + torch.arange(len(part))) % self.final_rows
            oldest = int(self.owner[slots].max()) + 1
            if oldest > self.start and not self._warned:
                self._warned = True
                getLogger("pgkit").warning(
                    "episodes end, or frames do not continue one another, more often than the replay has room for "
                    "final observations (%d): old frames leave before there are %d; ReplayBuffer(final_rows=...) is "
                    "that room, as large as the capacity for frames in no order",
                    self.final_rows, self.steps * self.columns,
                )  # fmt: skip
            self.start = max(self.start, oldest)
            self.owner[slots] = owners[part]
            self.finals += len(part)
            for key, x in obs.items():
                self.observations[key][self.rows + slots] = x[part]
            rows.append(self.rows + slots)
        return torch.cat(rows)


def differ(x: Tensor, y: Tensor) -> Tensor:
    """Which rows ``[rows, *shape]`` differ, ``[rows]``."""
    if torch.equal(x, y):  # fast, and the rule
        return torch.zeros(x.shape[0], dtype=torch.bool, device=x.device)
    return (x != y).unsqueeze(-1).flatten(1).any(-1)


def _allocate(storage: Storage, example: Mapping[Any, Tensor], rows: int) -> TensorDictBase:
    made, log = storage(rows), getLogger("torchrl")
    level = log.level
    log.setLevel("WARNING")  # TorchRL reports every allocation
    made.set(0, TensorDict(dict(example)))
    log.setLevel(level)
    return cast(TensorDictBase, made._storage)  # get() is limited to the rows that were set through the storage itself
