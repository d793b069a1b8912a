"""A TorchRL environment's step and its reset as functions of tensors, to be recorded."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from pgkit.compiled import Mode
from pgkit.envs.held import Slot, walk
from pgkit.envs.recorded import Function, Native, falls_back, record


class Halves:
    """``env.step_and_maybe_reset`` in two: the step, and the resets where an episode ended.

    Args:
        env: the environment; it is seeded, reset and steps once, for the names of its entries.

    Raises:
        RuntimeError: it resets itself.
    """

    def __init__(self, env: EnvBase) -> None:
        if vars(env).get("_torchrl_native_autoreset"):
            raise RuntimeError("it resets itself")
        self.env = env
        env.set_seed(0)
        done, fresh = env.step_and_maybe_reset(env.rand_action(env.reset()))
        self.next, self.fresh = _leaves(done.get("next")), _leaves(fresh)
        self.taken = [*self.fresh, *env.action_keys]
        self._data = [fresh, done.get("next")]

    def advance(self, *tensors: Tensor) -> list[Tensor]:
        """The entries ``next`` after a step from the entries ``taken``, and those of the state after it, ``fresh``."""
        out = self.env.step(self.filled(self.taken, tensors))
        fresh = self.env._step_mdp(out)
        if self.env._post_step_mdp_hooks is not None:  # of transforms
            out, fresh = self.env._post_step_mdp_hooks(out, fresh)
        return [*[out.get("next").get(key) for key in self.next], *[fresh.get(key) for key in self.fresh]]

    def renew(self, *tensors: Tensor) -> list[Tensor]:
        """The entries ``fresh`` after the resets of the episodes that they say are done."""
        data = self.env.maybe_reset(self.filled(self.fresh, tensors))
        return [data.get(key) for key in self.fresh]

    def filled(self, keys: Sequence[Any], tensors: Sequence[Tensor]) -> TensorDictBase:
        """Entries as the environment takes them."""
        example = self._data[keys is self.next].copy()
        for key, x in zip(keys, tensors, strict=True):
            example.set(key, x)
        return example

    def held(self) -> list[Slot]:
        """The tensors and numbers of the environment and of what it is made of, but for torch's and TorchRL's own."""
        package = type(innermost(self.env)).__module__.partition(".")[0]
        return list(walk(self.env, {package}))


def native(env: EnvBase, mode: Mode) -> tuple[Halves, Native] | None:
    """The halves of an environment's step, recorded on a copy of it; None where it cannot be recorded."""
    kind = type(innermost(env)).__name__
    with falls_back(f"the step of {kind}", mode), torch.random.fork_rng():
        twin = Halves(copy.deepcopy(env))

        def play(advance: Function, renew: Function) -> None:
            data = twin.env.reset()
            for _ in range(40):
                data = twin.env.rand_action(data)
                out = advance(*[data.get(key) for key in twin.taken])
                data = twin.filled(twin.fresh, renew(*out[len(twin.next) :]))

        found = record((twin.advance, twin.renew), twin.held, play, env.batch_size.numel(), mode, kind)
        halves = Halves(env)
        return halves, Native(found, halves.held, kind)
    return None


def _leaves(data: TensorDictBase) -> list[Any]:
    return list(data.keys(True, True))


def innermost(env: EnvBase) -> EnvBase:
    """The environment under its transforms, whose ``state_dict`` leaves it out."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env
