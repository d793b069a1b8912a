"""The inner loop of collecting: policy, simulator, buffers; no TensorDict."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pgkit.collectors.actor import is_state, memory, path_of
from pgkit.collectors.policy import RowPolicy, choices, function_of, padded_rows, random_actions
from pgkit.collectors.rebuild import Past
from pgkit.compiled import Mode, copy_all
from pgkit.envs import VectorEnv
from pgkit.errors import UserError
from pgkit.seams import Entries, Key, Simulator

MASK: Key = ("collector", "mask")
LARGEST = 1e18  # of observations and rewards: squared it is still finite in float32


def allocate(steps: int, env: VectorEnv, outputs: Entries) -> Entries:
    """Buffers ``[steps, N, ...]`` for a rollout, from the specs and from examples ``[N, ...]`` of the outputs."""
    made: dict[Any, Any] = {**dict(_specs(env.observation_spec)), **outputs}
    for key in filter(is_state, outputs):
        flag = torch.zeros(env.num_envs, 1, dtype=torch.bool, device=env.device)
        path: Any = path_of(key)[1:]
        made |= {path if len(path) > 1 else path[0]: outputs[key], "is_init": flag, ("next", "is_init"): flag}
    made |= {("next", *path_of(key)): x for key, x in [*_specs(env.observation_spec), *_specs(env.info_spec)]}
    for key, spec in _specs(env.full_reward_spec):
        made |= {("next", *path_of(key)): spec, ("next", *_total(key)): spec}
    made |= {("next", *path_of(key)): spec for key, spec in _specs(env.full_done_spec) if path_of(key)[-1] != "done"}
    made["next", "step_count"] = torch.zeros(env.num_envs, 1, dtype=torch.int64)
    if env.masks:
        made[MASK] = torch.ones(env.num_envs, dtype=torch.bool)
    device = env.device or torch.device("cpu")
    return {key: torch.zeros(steps, *x.shape, dtype=x.dtype, device=device) for key, x in made.items()}


class Share:
    """Some of the environments, the policy that acts in them, and its memory from step to step.

    Args:
        simulator: the environments.
        first: index of the first one in the whole vector.
        env: the whole vector.
        actor: the policy, on the simulator's device.
        outputs: examples of what it writes, ``[N, ...]``.
        buffers: of :func:`allocate`, the columns of these environments.
        mode: of the policy's native code (:func:`~pgkit.collectors.policy.trace`).
    """

    def __init__(
        self,
        simulator: Simulator,
        first: int,
        num_envs: int,
        seed: int,
        actor: TensorDictModuleBase,
        outputs: Entries,
        buffers: Entries,
        mode: Mode,
    ) -> None:
        self.simulator, self._first, self._num_envs, self._seed = simulator, first, num_envs, seed
        self._steps = len(next(iter(buffers.values())))
        self._observed = [key for key, _ in _specs(simulator.observation_spec)]
        self._actions = [key for key, _ in _specs(simulator.action_spec)]
        self._outputs = list(outputs)
        self._fresh: Entries | None = None
        self._amid: int | None = None  # the step at which a rollout began that is not finished
        self._start = memory(actor, simulator.num_envs, simulator.device)
        self._memory = self._start
        self._keys = [*self._observed, *self._memory]
        self._now, self._decided = _rows(buffers, self._keys), _rows(buffers, self._outputs)
        counted = buffers | {("next", "step_count"): buffers["next", "step_count"].squeeze(-1)}
        self._next = _rows(counted, [("next", *path_of(key)) for key in self._after()])
        self._mask = buffers[MASK].unbind(0) if simulator.masks else None
        spec = simulator.action_spec
        padded = padded_rows(self._now[0], num_envs)
        random = random_actions(spec if padded == spec.shape[0] else _padded(spec, padded), self._keys, outputs)
        self._random = RowPolicy(random, self._now[0], num_envs, first, seed)
        self.retrace(actor, mode)

    def _after(self) -> list[Key]:
        """The entries of a step in the order in which they are written."""
        sim = self.simulator
        rewards = [key for key, _ in _specs(sim.reward_spec)]
        ends = [path_of(key)[:-1] for key, _ in _specs(sim.done_spec) if path_of(key)[-1] == "done"]
        flags: list[Key] = [*[(*path, "terminated") for path in ends], *[(*path, "truncated") for path in ends]]
        infos = [key for key, _ in _specs(sim.info_spec)]
        return [*self._observed, *rewards, *flags, *infos, *[_total(key) for key in rewards], "step_count"]

    def retrace(self, actor: TensorDictModuleBase, mode: Mode) -> None:
        """Records the policy anew."""
        act = function_of(actor, self._keys)
        self._policy = RowPolicy(act, self._now[0], self._num_envs, self._first, self._seed, actor, mode)

    @torch.inference_mode()
    def collect(self, step: int, random: bool = False) -> None:
        """Steps the environments through the buffers; ``step`` counts their steps since the beginning."""
        policy, simulator = self._random if random else self._policy, self.simulator
        if self._fresh is None or self._amid is not None:  # an earlier rollout was broken off
            self._fresh, self._memory = simulator.reset(), self._start
        self._amid = step
        fresh, remembered, observed = self._fresh, self._memory, self._observed
        actions = [(key, self._outputs.index(key)) for key in self._actions]
        states = [at for at, key in enumerate(self._outputs) if is_state(key)]
        kept = [key for key in remembered if key != "is_init"]
        with policy.steps(step, self._steps) as noise:
            for now, decided, after, drawn, t in zip(
                self._now, self._decided, self._next, noise, range(self._steps), strict=True
            ):
                copy_all(now, [*[fresh[key] for key in observed], *remembered.values()])
                outputs = policy(now, drawn)
                copy_all(decided, outputs)
                made = simulator.step({key: outputs[at] for key, at in actions})
                copy_all(after, [
                    *[made.next[key] for key in observed], *made.reward.values(), *made.terminated.values(),
                    *made.truncated.values(), *made.info.values(), *simulator.episode_reward.values(),
                    simulator.step_count,
                ])  # fmt: skip
                fresh = made.fresh
                if remembered:
                    remembered = {"is_init": made.begun().unsqueeze(-1)}
                    remembered |= {key: outputs[at] for key, at in zip(kept, states, strict=True)}
                if self._mask is not None and made.mask is not None:
                    self._mask[t].copy_(made.mask)
        self._fresh, self._memory, self._amid = fresh, remembered, None

    @torch.inference_mode()
    def rebuild(self, past: Past) -> None:
        """Goes on where another share was: from a state that it told, through the actions that it took since."""
        if past.state is not None:
            self.load_state_dict(pickle.loads(past.state))
        elif self._fresh is None:
            self._fresh = self.simulator.reset()
        for actions in past.actions:
            for now in zip(*(x.unbind(0) for x in actions.values()), strict=True):
                made = self.simulator.step(dict(zip(actions, now, strict=True)))
                self._fresh, begun = made.fresh, made.begun()
        if past.actions and self._memory:
            names = [key for key in self._memory if key != "is_init"]
            self._memory = {"is_init": begun.unsqueeze(-1), **dict(zip(names, past.memory.values(), strict=True))}

    def state_dict(self) -> dict[str, Any]:
        """The simulator's state, and the policy's memory; amid a rollout there is none to go on from."""
        if self._amid is not None:
            return lost(self._amid)
        return {"simulator": self.simulator.state_dict(), "memory": {k: x.clone() for k, x in self._memory.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from :meth:`state_dict`, as the simulator's ``resume`` says."""
        self._fresh, self._memory = self.simulator.load_state_dict(state["simulator"]), self._start
        if state["memory"] and self.simulator.resume == "exact":
            self._memory = {key: x.to(self.simulator.device) for key, x in state["memory"].items()}


def lost(steps: int) -> dict[str, Any]:
    """Stands for the state of a share that is gone after so many steps: its environments begin new episodes."""
    return {"simulator": {"steps": steps}, "memory": {}}


def regroup(states: Sequence[dict[str, Any]], bounds: Sequence[int]) -> list[dict[str, Any]]:
    """The states of shares as those of other shares, from ``bounds[i]`` to ``bounds[i + 1]``.

    Raises:
        UserError: environments whose states cannot be taken apart.
    """
    simulators, counts = [state["simulator"] for state in states], len(bounds) - 1
    if "rows" not in simulators[0]:
        if len(states) == counts:
            return list(states)
        if simulators[0].keys() == {"steps"}:  # they begin anew in any case
            return [states[0]] * counts
        raise UserError(
            f"the checkpoint is of {len(states)} processes, there are {counts} now, and the states of these "
            "environments cannot be taken apart: resume with the same --workers"
        )
    rows = [row for simulator in simulators for row in simulator["rows"]]
    kept = {key: torch.cat([state["memory"][key] for state in states]) for key in states[0]["memory"]}
    parts = [(a - bounds[0], b - bounds[0]) for a, b in pairwise(bounds)]
    return [
        {"simulator": simulators[0] | {"rows": rows[a:b]}, "memory": {key: x[a:b] for key, x in kept.items()}}
        for a, b in parts
    ]


def as_rollout(buffers: Entries, env: VectorEnv) -> TensorDictBase:
    """The buffers ``[T, N, ...]`` as a TensorDict ``[N, T]``, without a copy, and ``("next", ..., "done")``."""
    tensors: dict[Any, Tensor] = {key: x.transpose(0, 1) for key, x in buffers.items()}
    for key in [key for key in tensors if path_of(key)[-1] == "terminated"]:
        tensors[(*key[:-1], "done")] = tensors[key] | tensors[(*key[:-1], "truncated")]
    _check(tensors, env)
    return _nested({path_of(key): x for key, x in tensors.items()}, env.groups)


def _nested(
    entries: dict[tuple[str, ...], Tensor], shapes: dict[tuple[str, ...], torch.Size], at: tuple[str, ...] = ()
) -> TensorDictBase:
    """Nested TensorDicts; checking each entry costs a tenth of a millisecond a rollout, so none is."""
    source: dict[str, Any] = {}
    groups: dict[str, dict[tuple[str, ...], Tensor]] = {}
    for path, x in entries.items():
        if len(path) == 1:
            source[path[0]] = x
        else:
            groups.setdefault(path[0], {})[path[1:]] = x
    for name, group in groups.items():
        source[name] = _nested(group, shapes, () if name == "next" else (*at, name))
    batch = next(iter(entries.values())).shape[:2]
    return TensorDict._new_unsafe(source=source, batch_size=batch + shapes.get(at, torch.Size()))


def _check(tensors: dict[Any, Tensor], env: VectorEnv) -> None:
    """A ``UserError`` for numbers that are not finite, and for masks that allow no action."""
    for key, _ in _specs(env.observation_spec):
        for where in (("next", *path_of(key)), key):
            _check_finite(tensors[where], where)
        if path_of(key)[-1] == "action_mask":
            spec = env.full_action_spec[(*path_of(key)[:-1], "action")]
            if not all(x.any(-1).all() for x in choices(spec, tensors[key])):
                raise UserError(
                    "the environment's action_mask allows no action in some state: it must allow at least one"
                )
    for key, _ in _specs(env.full_reward_spec):
        where = ("next", *path_of(key))
        _check_finite(tensors[where], where)


def _check_finite(x: Tensor, key: Key) -> None:
    if not x.dtype.is_floating_point or not x.numel():
        return
    low, high = x.aminmax()  # NaN where one is
    if low >= -LARGEST and high <= LARGEST:
        return
    wrong = ~(x.abs() <= LARGEST)
    row, step = wrong.nonzero()[0, :2].tolist()
    found, name = x[row, step][wrong[row, step]].flatten()[0].item(), ".".join(path_of(key))
    raise UserError(
        f"'{name}' of environment {row} is {found:g} at step {step} of the rollout: the update would turn every "
        "weight into NaN; mend the environment, or clip it in a wrapper (gymnasium.wrappers.TransformObservation)"
    )


def _rows(buffers: Entries, keys: Iterable[Key]) -> list[list[Tensor]]:
    """For each step, the rows of these entries."""
    columns = [buffers[key[0] if isinstance(key, tuple) and len(key) == 1 else key].unbind(0) for key in keys]
    return [list(row) for row in zip(*columns, strict=True)]


def _specs(spec: Any) -> list[tuple[Any, Any]]:
    return [(key, spec[key]) for key in spec.keys(True, True)]


def _total(key: Any) -> tuple[str, ...]:
    """The name of the running sum of a reward."""
    return (*path_of(key)[:-1], f"episode_{path_of(key)[-1]}")


def _padded(spec: Any, rows: int) -> Any:
    """The spec of more rows."""
    return spec[:1].expand(rows)
