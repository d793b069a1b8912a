"""A replay buffer whose hot path is slices and indices of tensors: no TensorDict work a frame."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from pgkit.data import files, stacks
from pgkit.data.gather import Gather, gather
from pgkit.data.prioritized import Prioritized
from pgkit.data.table import Storage, Table
from pgkit.errors import UserError, check_whole_number
from pgkit.seams import Entries, Key

MASK = ("collector", "mask")


class ReplayBuffer:
    """The last ``capacity`` frames of ``env``, on TorchRL's storages.

    :meth:`extend` writes a rollout ``[num_envs, T]`` by slices, :meth:`sample_index` draws the row numbers of many
    batches at once, and the update gathers the rows inside its compiled step. An observation is stored once
    (:class:`~pgkit.data.table.Table`): the next observation is that of the next step, final observations of episodes
    have rows of their own, and of a stack of frames the newest alone is stored. Where there are more endings than
    ``final_rows``, the oldest frames leave early; none is ever wrong.

    Args:
        env: shapes, dtypes and the number of columns come from its specs.
        capacity: frames to keep.
        n_steps: length of the returns: a sample's reward is the discounted sum of up to so many rewards, cut at the
            end of an episode; ``steps_to_next_obs`` has the number of them. The discount is the loss's.
        sampler: :class:`~pgkit.data.Prioritized`; None draws uniformly.
        storage: makes a TorchRL storage of so many rows, e.g. :func:`~pgkit.data.in_files` for a
            buffer beyond RAM; by default in the memory of ``device``.
        final_rows: final observations to keep; by default an eighth of the capacity, with frame stacks a sixteenth.
        entries: further entries of the rollouts to keep, with an example of one frame's: ``{"action_log_prob":
            torch.zeros(())}``. They come back in every batch.
        frame_stack: observations that stack so many frames along their first dimension (channels), the newest last:
            ``{"pixels": 3}``, or the number where there is one observation. By default ``env.frame_stack``. Batches
            have the stacks; change none of their observations in place.
        device: where the frames are kept and batches are made.
        seed: of the draws, which are made on the CPU: the same on every device; by default drawn from torch's global
            generator.

    Raises:
        UserError: the frames do not fit in memory, or a stack does not fit its observation or the capacity.
    """

    def __init__(
        self,
        env: EnvBase,
        capacity: int = 1_000_000,
        *,
        n_steps: int = 1,
        sampler: Prioritized | None = None,
        storage: Storage | None = None,
        final_rows: int | None = None,
        entries: Mapping[str, Tensor] | None = None,
        frame_stack: Mapping[Key, int] | int | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
    ) -> None:
        if not isinstance(env, EnvBase):
            raise UserError(f"ReplayBuffer(env, capacity): env is a {type(env).__name__}, give what envs.make gives")
        if sampler is not None and (isinstance(sampler, type) or not hasattr(sampler, "write_back")):
            raise UserError(f"sampler={sampler!r}: give data.Prioritized(), or None to draw uniformly")
        check_whole_number(1, capacity=capacity, n_steps=n_steps, final_rows=final_rows)
        self.columns, self.capacity, self.n_steps, self.sampler = env.batch_size.numel(), capacity, n_steps, sampler
        if capacity < self.columns:
            raise UserError(
                f"a replay buffer of capacity {capacity} does not hold one frame of each of the {self.columns} "
                "environments: raise the capacity"
            )
        observation, frame = _examples(env, entries or {})
        self.env_name, self.entries = str(vars(env).get("env_id", type(env).__name__)), list(entries or ())
        self.device = torch.device(device)
        stacked = stacks.check(frame_stack or vars(env).get("frame_stack"), observation, capacity // self.columns)
        self.final_rows = final_rows or max(capacity // (16 if stacked else 8), self.columns)
        self.table = Table(
            observation, frame, capacity=capacity, columns=self.columns, final_rows=self.final_rows, stacked=stacked,
            storage=storage, device=self.device,
        )  # fmt: skip
        self.data = self.table.data
        self._errors: Tensor | None = None
        self._ignored: Tensor | None = None  # rows that a mask leaves out, [rows] on the CPU, where rollouts have one
        if sampler is not None:
            self.data["weighting"] = sampler.begin(self.rows, self.device)
        self.generator = torch.Generator().manual_seed(int(torch.randint(2**62, ())) if seed is None else seed)

    @property
    def written(self) -> int:
        """Frames ever stored."""
        return self.table.written

    @property
    def start(self) -> int:
        """The oldest frame that is kept, counted as :attr:`written` is; its row is ``start % rows``."""
        return self.table.start

    @property
    def rows(self) -> int:
        """Rows of the ring that frames are written to."""
        return self.table.rows

    def __len__(self) -> int:
        """Frames that can be sampled now."""
        return max(self.written - (self.n_steps - 1) * self.columns - self.start, 0)

    @torch.no_grad()
    def extend(self, rollout: TensorDictBase) -> None:
        """Writes a rollout ``[num_envs, T]`` (or ``[num_envs]``: one step) with TorchRL's ``next`` entries.

        Where draws are prioritized, an entry ``td_error [num_envs, T]`` has the frames' first errors. Without one, they
        get the largest priority so far. Frames that ``("collector", "mask")`` leaves out are never drawn.

        Rollouts need not continue one another: where an observation is not the one that the frame before led to,
        that frame keeps its own.

        Raises:
            UserError: an entry is missing, or the rollout is of another number of environments.
        """
        if rollout.batch_size.numel() % self.columns or (self.columns > 1 and rollout.batch_size[0] != self.columns):
            raise UserError(
                f"the replay buffer was made for {self.columns} environments, the rollout's batch size is "
                f"{tuple(rollout.batch_size)}: it must be [{self.columns}, T]"
            )
        after = rollout.get("next", None)
        if after is None:
            raise UserError(
                "the rollout to store has no 'next': give next.observation, next.reward, next.terminated, ..."
            )
        now, after = partial(self._rows_of, "rollout", rollout), partial(self._rows_of, "next", after)
        oldest, ready = self.start, self.start + len(self)
        self.table.write(
            {key: now(key).to(x.dtype) for key, x in self.table.observations.items()},
            {key: after(key).to(x.dtype) for key, x in self.table.observations.items()},
            {key: now(key) for key in ("action", *self.entries)}
            | {key: after(key) for key in ("reward", "terminated", "done")},
        )
        self._note_ignored(rollout)
        if self.sampler is not None:
            new = torch.arange(max(ready, self.start), self.start + len(self)) % self.rows
            new = new if self._ignored is None else new[~self._ignored[new]]
            self.sampler.extend(new, torch.arange(oldest, self.start) % self.rows, self._first_errors(rollout, new))

    def _note_ignored(self, rollout: TensorDictBase) -> None:
        """Which of the newest rows a mask leaves out; the tensor is made for the first mask."""
        mask = rollout.get(MASK, None)
        if mask is None and self._ignored is None:
            return
        out = torch.zeros(rollout.numel(), dtype=torch.bool)
        if mask is not None:
            out = ~self._rows_of("rollout", rollout, MASK).flatten().cpu()
        if self._ignored is None:
            self._ignored = torch.zeros(self.rows, dtype=torch.bool)
        self._ignored[torch.arange(self.written - len(out), self.written) % self.rows] = out

    def _first_errors(self, rollout: TensorDictBase, new: Tensor) -> Tensor | None:
        """The errors that the rows ``new`` came with: with n-step returns some are of the rollout before."""
        if "td_error" not in rollout.keys():
            return None
        errors = self._rows_of("rollout", rollout, "td_error")
        if self._errors is None:
            self._errors = torch.zeros(self.rows, dtype=errors.dtype, device=self.device)
        self._errors[torch.arange(self.written - len(errors), self.written) % self.rows] = errors
        return self._errors[new]

    def _rows_of(self, name: str, data: TensorDictBase, key: Any) -> Tensor:
        """An entry of a rollout ``[columns, T]`` in time order, ``[T * columns, ...]``: the newest that fit."""
        x, dims = data.get(key, None), data.batch_dims
        if x is None:
            raise UserError(f"the {name} to store has no '{key}', only {', '.join(map(str, data.keys()))}")
        x = x.to(self.device, non_blocking=self.device.type != "cpu")  # the CPU would read it before it is there
        steps = data.batch_size.numel() // self.columns
        if steps == 1:
            return x.reshape(self.columns, *x.shape[dims:])
        x = x.reshape(self.columns, steps, *x.shape[dims:]).transpose(0, 1)
        return x[-(self.rows // self.columns - 1) :].reshape(-1, *x.shape[2:])

    def sample_index(self, batch_size: int, batches: int = 1) -> Tensor:
        """Row numbers ``[batches, batch_size]``, drawn with replacement.

        Raises:
            UserError: fewer frames are stored than a batch has.
        """
        check_whole_number(1, batch_size=batch_size, batches=batches)
        if batch_size > len(self):
            raise UserError(
                f"batch_size={batch_size} is above the {len(self)} frames stored: collect more frames first"
            )
        if self.sampler is not None:
            return self.sampler.sample(batches, batch_size, self.generator)
        return self._uniform(batches * batch_size).view(batches, batch_size).to(self.device)

    def _uniform(self, count: int) -> Tensor:
        """So many rows that count, each as likely as another; on the CPU."""
        index = (torch.randint(len(self), (count,), generator=self.generator) + self.start) % self.rows
        if self._ignored is not None and len(out := self._ignored[index].nonzero().squeeze(-1)):
            index[out] = self._uniform(len(out))
        return index

    def sample(self, batch_size: int, gamma: float | Tensor = 1.0) -> TensorDictBase:
        """A batch ``[batch_size]`` of transitions with TorchRL's keys; ``gamma`` counts where ``n_steps > 1``."""
        return self.gather(gamma)(self.data, self.sample_index(batch_size)[0])

    def write_back(self, data: TensorDictBase, index: Tensor, batch: TensorDictBase) -> None:
        """Makes the ``td_error`` of a batch the priorities of its rows, where the draws are prioritized."""
        if self.sampler is not None:
            self.sampler.write_back(index, batch["td_error"].flatten())

    def gather(self, gamma: float | Tensor) -> Gather:
        """``(data, index) -> batch`` of :attr:`data`, a function of tensors that can be compiled."""
        return partial(gather, rows=self.rows, n_steps=self.n_steps, gamma=gamma, stacked=self.table.stacked)

    def clear(self) -> None:
        """Forgets every frame."""
        if self.sampler is not None:
            self.sampler.extend(torch.arange(0), torch.arange(self.rows))
        self.table.clear()
        self._ignored = None

    def state_dict(self) -> dict[str, Any]:
        """Everything stored, and the state of the draws."""
        return {
            "made_for": self._made_for(),
            "table": self.table.state_dict(),
            "generator": self.generator.get_state(),
            "sampler": None if self.sampler is None else self.sampler.state_dict(),
            "ignored": None if self._ignored is None else self._ignored.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`; a ``UserError`` if it is of another environment or another size."""
        theirs = state["made_for"]
        for name, value in self._made_for().items():
            if theirs.get(name) != value:
                raise UserError(
                    f"the saved replay buffer is another one: its {name} is {theirs.get(name)}, here it is {value}; "
                    "give the same environment and settings, or train without the saved buffer"
                )
        self.clear()
        self.table.load_state_dict(state["table"])
        self.generator.set_state(state["generator"])
        if self.sampler is not None:
            self.sampler.load_state_dict(state["sampler"])
        self._ignored = state.get("ignored")  # an earlier pgkit saved none

    def save(self, path: str | Path) -> None:
        """Writes :meth:`state_dict` to a file of its own, in one step."""
        files.save(self, Path(path))

    def load(self, path: str | Path) -> None:
        """Reads what :meth:`save` wrote; a ``UserError`` where there is no file, or it is damaged."""
        files.load(self, Path(path))

    def _made_for(self) -> dict[str, Any]:
        table = self.table
        return {
            "environment": self.env_name,
            "observation": {str(key): tuple(x.shape[1:]) for key, x in table.observations.items()},
            "frame_stack": {str(key): k for key, k in table.stacked.items()},
            "action": tuple(table.frames["action"].shape[1:]),
            "entries": {key: tuple(table.frames[key].shape[1:]) for key in self.entries},
            "num_envs": self.columns,
            "n_steps": self.n_steps,
            "capacity": self.capacity,
            "final_rows": self.final_rows,
            "prioritized": self.sampler is not None,
        }


def _examples(env: EnvBase, entries: Mapping[str, Tensor]) -> tuple[Entries, dict[str, Tensor]]:
    """One frame's observations, and its other entries."""
    spec, flag = env.observation_spec_unbatched, torch.zeros(1, dtype=torch.bool)
    zeros = {key: spec[key].zero() for key in spec.keys(True, True)}
    observation = {key: x for key, x in zeros.items() if isinstance(x, Tensor)}
    frame = {"action": env.action_spec_unbatched.zero(), "reward": torch.zeros(1), "terminated": flag, "done": flag}
    if twice := [key for key in entries if key in frame or key in observation]:
        raise UserError(f"entries={list(entries)}: '{twice[0]}' is kept anyway, leave it out")
    return observation, frame | dict(entries)
