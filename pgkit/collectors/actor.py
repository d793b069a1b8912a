"""What a collector asks of an actor: what it reads and writes, whether it fits the environment, where it is."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import OrnsteinUhlenbeckProcessModule

from pgkit.envs import VectorEnv
from pgkit.errors import UserError
from pgkit.seams import Entries, Key, Memory, Noisy


def state_of(actor: torch.nn.Module) -> tuple[Key, Sequence[int]] | None:
    """Key and shape of the state that an actor carries from step to step; None for an actor without memory."""
    found = next((part for part in actor.modules() if isinstance(part, Memory)), None)
    if found is None:
        return None
    key = found.state_key
    return (key[0] if len(path_of(key)) == 1 and not isinstance(key, str) else key), found.state_shape


def path_of(key: Key) -> tuple[str, ...]:
    """A nested key as a tuple."""
    return (key,) if isinstance(key, str) else key


def is_state(output: Key) -> bool:
    """Whether an actor's output is its state after a step."""
    return path_of(output)[0] == "next"


def output_keys(actor: TensorDictModuleBase) -> list[Any]:
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
    return [*samples, *[key for key in actor.out_keys if key in log_probs or is_state(key)]]


def memory(actor: TensorDictModuleBase, num_envs: int, device: torch.device | None = None) -> dict[Key, Tensor]:
    """What a recurrent actor reads besides the observation, at the start of an episode; nothing for any other."""
    if (state := state_of(actor)) is None:
        return {}
    key, shape = state
    is_init = torch.ones(num_envs, 1, dtype=torch.bool, device=device)
    return {"is_init": is_init, key: torch.zeros(num_envs, *shape, device=device)}


@contextmanager
def acting(actor: torch.nn.Module) -> Iterator[None]:
    """The mode in which a policy acts: evaluation, so that no statistic moves and no dropout draws.

    Layers of noise (those with ``reset_noise``, such as ``NoisyLinear``) explore, and stay in training mode.
    """
    modes = [(part, part.training) for part in actor.modules()]
    for part, _ in modes:
        part.training = isinstance(part, Noisy)
    try:
        yield
    finally:
        for part, mode in modes:
            part.training = mode


def example(env: VectorEnv, actor: TensorDictModuleBase) -> Entries:
    """The actor's outputs for observations of zeros, by key, checked against the environment's action spec."""
    keys, entries, device = output_keys(actor), env.observation_spec.zero(), env.observation_spec.device
    data = TensorDict({**entries, **memory(actor, env.num_envs, device)}, batch_size=(env.num_envs,))
    missing = [key for key in actor.in_keys if key not in data.keys(True)]
    if missing:
        raise UserError(
            f"the actor reads '{missing[0]}', the environment observes {', '.join(map(str, entries.keys()))}: build "
            "the actor from this environment; envs.make(..., flatten=False) keeps a Dict observation's entries apart"
        )
    if any(isinstance(part, OrnsteinUhlenbeckProcessModule) for part in actor.modules()):
        raise UserError(
            "TorchRL's OrnsteinUhlenbeckProcessModule keeps its noise in the TensorDict of the step before, which this "
            "collector does not have: modules.OrnsteinUhlenbeck(actor, env) is carried from step to step"
        )
    check_types(actor, data)
    misfit = "the actor was built for another environment: build it from this one (modules.gaussian_actor(env))"
    with torch.no_grad(), acting(actor), torch.random.fork_rng(), set_exploration_type(ExplorationType.RANDOM):
        try:
            out = actor(data.to(device_of(actor, env)))
        except RuntimeError as error:
            shapes = ", ".join(str(tuple(x.shape[1:])) for x in entries.values(True, True))
            reason = str(error).strip().partition("\n")[0]
            raise UserError(f"the actor cannot read observations of shape {shapes}; {misfit} [{reason}]") from error
    for key in env.action_keys:
        action, spec = out.get(key), env.full_action_spec[key]
        if action.shape != spec.shape or action.dtype.is_floating_point != spec.dtype.is_floating_point:
            raise UserError(
                f"the actor's action is {tuple(action.shape[1:])} {action.dtype}, the environment's "
                f"{tuple(spec.shape[1:])} {spec.dtype}; {misfit}"
            )
    return {key: out[key].to(env.device or "cpu") for key in keys}


def check_types(actor: TensorDictModuleBase, data: Any) -> None:
    """A ``UserError`` where an observation is of another floating type than the actor's weights."""
    types = {p.dtype for p in actor.parameters() if p.dtype.is_floating_point}
    for key in actor.in_keys:
        dtype = data.get(key).dtype if key in data.keys(True) else torch.bool
        if dtype.is_floating_point and types and dtype not in types:
            found, wanted = (str(x).removeprefix("torch.") for x in (dtype, min(types, key=str)))
            raise UserError(
                f"'{key}' is {found}, the actor's weights are {wanted}: convert it (TransformedEnv(env, "
                "DoubleToFloat())), or the actor with .to(dtype)"
            )


def device_of(actor: TensorDictModuleBase, env: VectorEnv) -> torch.device:
    """Where the actor's weights are; without any, where the environments are."""
    return next((x.device for x in (*actor.parameters(), *actor.buffers())), torch.device(env.device or "cpu"))


class Beside:
    """A copy of an actor on the environments' device, where the actor's own is another; else the actor itself."""

    def __init__(self, actor: TensorDictModuleBase, env: VectorEnv) -> None:
        device = torch.device(env.device or "cpu")
        self.home, self.source = device_of(actor, env), actor
        self.moves = self.home.type != device.type
        self.actor = copy.deepcopy(actor).to(device).requires_grad_(False) if self.moves else actor

    @torch.no_grad()
    def refresh(self) -> None:
        """Brings the weights of now."""
        if self.moves:
            for mine, theirs in zip(self.actor.state_dict().values(), self.source.state_dict().values(), strict=True):
                mine.copy_(theirs)

    def bring(self, rollout: TensorDictBase) -> TensorDictBase:
        """The rollout, where the actor is."""
        if not self.moves:
            return rollout
        if self.home.type == "cuda":
            rollout = rollout.pin_memory()
        return rollout.to(self.home, non_blocking=True)
