"""A TensorDict actor as a plain function of tensors, for the inner stepping loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from logging import getLogger
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torchrl.data import MultiCategorical, TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import OrnsteinUhlenbeckProcessModule

from pgkit.compiled import Mode, compiled, undone
from pgkit.envs import VectorEnv
from pgkit.envs.vector import whole
from pgkit.errors import UserError

Act = Callable[..., tuple[Tensor, ...]]
STATE = ("next", "recurrent_state")


def output_keys(actor: TensorDictModuleBase) -> list[NestedKey]:
    """What a rollout keeps of an actor's outputs: its samples and their log-probabilities."""
    samples: Any = getattr(actor, "dist_sample_keys", None)
    if not hasattr(actor, "out_keys"):
        raise UserError(
            f"the collector takes a TensorDict module as actor, this is a {type(actor).__name__}: wrap it, "
            "TensorDictModule(net, in_keys=['observation'], out_keys=['action'])"
        )
    if not samples:
        return list(actor.out_keys)
    log_probs: Any = actor.log_prob_keys
    return [*samples, *[key for key in (*log_probs, STATE) if key in actor.out_keys]]


def memory(actor: TensorDictModuleBase, num_envs: int) -> dict[str, Tensor]:
    """What a recurrent actor reads besides the observation, at the start of an episode; nothing for any other."""
    size = next((int(m.state_size) for m in actor.modules() if hasattr(m, "state_size")), 0)
    start = {"is_init": torch.ones(num_envs, 1, dtype=torch.bool), "recurrent_state": torch.zeros(num_envs, size)}
    return start if size else {}


def trace(
    actor: TensorDictModuleBase,
    obs: Tensor,
    mode: Mode = "off",
    split: Callable[[Tensor], dict[str, Tensor]] = whole,
) -> Act:
    """A function from observations of the shape of ``obs`` to the tensors at :func:`output_keys`.

    It is :func:`policy`, bound. A recurrent actor's function takes the entries of :func:`memory` too. ``split`` makes
    entries of ``obs``.

    It is the actor's own sequence of tensor operations, recorded once and called without TensorDict: the same numbers
    bit for bit, at about a quarter of the cost for a small network. Compiled, it halves that again and rounds
    differently in the last bits. Parameters and buffers are referred to, not copied, so weights changed in place take
    effect; plain attributes are fixed. An actor that cannot be recorded (Python control flow that depends on data,
    numpy) is called as it is.

    Args:
        mode: of :func:`pgkit.compiled.compiled`; ``off`` records all the same, which changes no bit.
    """
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        native, *inputs = policy(actor, obs, mode, split)
        return native.bind(None, *inputs)


def policy(
    actor: TensorDictModuleBase,
    obs: Tensor,
    mode: Mode = "off",
    split: Callable[[Tensor], dict[str, Tensor]] = whole,
) -> tuple[Any, ...]:
    """The actor behind the door to native code, and the inputs to bind it to: ``(compiled, obs, *memory)``."""
    keys = output_keys(actor)
    remembered = memory(actor, len(obs))

    def act(_: None, obs: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        entries = split(obs) | dict(zip(remembered, state, strict=True))
        out = actor(TensorDict(entries, batch_size=obs.shape[:1]))
        return tuple(out[key] for key in keys)

    def others(_: None, obs: Tensor, *state: Tensor) -> list[tuple[Any, ...]]:
        return [(None, _other(obs, seed, spread), *state) for seed, spread in enumerate((0.1, 1.0, 10.0))]

    mode = "record" if mode == "off" else mode
    with torch.no_grad(), _LeavesTorch() as leaves:
        undone(actor.buffers(), lambda: act(None, obs, *remembered.values()))
    if leaves.seen:
        getLogger("pgkit").info("the policy computes outside torch: it is called as it is, several times slower")
        mode = "off"
    native = compiled(act, watch={"the actor": actor}, others=others, mode=mode, name="the policy")
    return native, obs, *remembered.values()


class _LeavesTorch(TorchFunctionMode):
    """Notices tensors that become numpy arrays or lists: what is computed from those is a constant of a record."""

    seen = False

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.seen |= func in (Tensor.numpy, Tensor.tolist, Tensor.__array__)
        return func(*args, **(kwargs or {}))


def _other(obs: Tensor, seed: int, spread: float) -> Tensor:
    """Other observations of the same type: noise on numbers, any pixels, flags and integers in another order."""
    draw = torch.Generator(obs.device).manual_seed(seed)
    if obs.dtype.is_floating_point:
        return obs + spread * torch.randn(obs.shape, generator=draw, dtype=obs.dtype, device=obs.device)
    if obs.dtype is torch.uint8:
        return torch.randint(256, obs.shape, generator=draw, dtype=obs.dtype, device=obs.device)
    return obs.flatten()[torch.randperm(obs.numel(), generator=draw, device=obs.device)].view_as(obs)


def random_actions(
    spec: TensorSpec,
    outputs: dict[NestedKey, Tensor],
    split: Callable[[Tensor], dict[str, Tensor]] = whole,
) -> Act:
    """A policy that draws actions uniformly from ``spec``, of those that an ``action_mask`` allows.

    Its other outputs, shaped as ``outputs``, are NaN; a recurrent state stays zero.
    """
    others = {
        key: torch.full_like(x, 0.0 if key == STATE else torch.nan) for key, x in outputs.items() if key != "action"
    }

    def act(obs: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        mask = split(obs).get("action_mask")
        action = spec.rand() if mask is None else _allowed(spec, mask.bool())
        return tuple(action if key == "action" else others[key] for key in outputs)

    return act


def _allowed(spec: TensorSpec, mask: Tensor) -> Tensor:
    """Discrete actions drawn uniformly of those that a mask ``[N, choices]`` allows."""
    parts = []
    for part in choices(spec, mask):
        possible = part | ~part.any(-1, keepdim=True)  # a worker's padding allows nothing, and is thrown away
        parts.append(torch.multinomial(possible.float(), 1))
    return torch.cat(parts, -1) if isinstance(spec, MultiCategorical) else parts[0].squeeze(-1)


def choices(spec: TensorSpec, mask: Tensor) -> Sequence[Tensor]:
    """The parts of an action mask ``[*B, n]`` that belong to one choice each."""
    if not isinstance(spec, MultiCategorical):
        return [mask]
    return mask.split(spec.nvec.reshape(-1, spec.shape[-1])[0].tolist(), -1)


def check_env(env: Any, collector: Any) -> None:
    """A UserError for an environment whose arrays a collector of pgkit cannot step by itself."""
    if not isinstance(env, VectorEnv):
        raise UserError(
            f"{type(collector).__name__} steps what envs.make gives, a {type(env).__name__} is none of that: use "
            "collectors.TorchRLCollector"
        )


def example(env: VectorEnv, actor: TensorDictModuleBase) -> tuple[Tensor, ...]:
    """The actor's outputs for observations of zeros, checked against the environment's action spec."""
    entries, spec = env.observation_spec.zero(), env.action_spec
    data = TensorDict({**entries, **memory(actor, env.num_envs)}, batch_size=(env.num_envs,))
    missing = [key for key in actor.in_keys if key not in data.keys(True)]
    if missing:
        raise UserError(
            f"the actor reads '{missing[0]}', the environment observes {', '.join(map(str, entries.keys()))}: build "
            "the actor from this environment; envs.make(..., flatten=False) keeps a Dict observation's entries apart"
        )
    if elsewhere := [p.device for p in actor.parameters() if p.device.type != "cpu"]:
        raise UserError(f"the actor is on {elsewhere[0]}, environments and collectors are on the CPU: actor.to('cpu')")
    if any(isinstance(part, OrnsteinUhlenbeckProcessModule) for part in actor.modules()):
        raise UserError(
            "TorchRL's OrnsteinUhlenbeckProcessModule keeps its noise in the TensorDict of the step before, which this "
            "collector does not have: modules.OrnsteinUhlenbeck(actor, env) is carried from step to step"
        )
    misfit = "the actor was built for another environment: build it from this one (modules.gaussian_actor(env))"
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        try:
            out = actor(data)
        except RuntimeError as error:
            shapes = ", ".join(str(tuple(x.shape[1:])) for x in entries.values())
            reason = str(error).strip().partition("\n")[0]
            raise UserError(f"the actor cannot read observations of shape {shapes}; {misfit} [{reason}]") from error
    action = out["action"]
    if action.shape != spec.shape or action.dtype.is_floating_point != spec.dtype.is_floating_point:
        raise UserError(
            f"the actor's action is {tuple(action.shape[1:])} {action.dtype}, the environment's "
            f"{tuple(spec.shape[1:])} {spec.dtype}; {misfit}"
        )
    return tuple(out[key] for key in output_keys(actor))
