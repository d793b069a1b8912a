"""What a recipe trains, and how a run directory gives it back: built again from settings, then loaded."""

from __future__ import annotations

import contextlib
import logging
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from pgkit.cli import recipes
from pgkit.envs import vector_of
from pgkit.errors import UserError
from pgkit.run import checkpoint, seeding
from pgkit.run.args import RunArgs
from pgkit.run.config import check_imports, digest, read_config, saved_args

Which = Literal["best", "latest"]


@dataclass
class Agent:
    """What a recipe's ``agent(args, env)`` builds: the networks and everything that trains them, but the optimizer.

    A run saves the parts that are modules.

    Attributes:
        actor: the policy that is evaluated and exported; its normalizer is in it.
        loss: what is minimized; the critics with their targets are in it.
        critic: the critics as a module, for the optimizer.
        advantage: the estimator of an on-policy update.
        explorer: the policy that collects, where it is not the actor.
        normalizer: of observations; the recipe calls its ``update``.
        scale: of returns; the recipe calls its ``update``.
        controller: a temperature, or the weight of a penalty.
    """

    actor: nn.Module
    loss: Any = None
    critic: Any = None
    advantage: Any = None
    explorer: Any = None
    normalizer: Any = None
    scale: Any = None
    controller: Any = None

    def parameters(self) -> list[nn.Parameter]:
        """The weights of actor and critic, those of both once."""
        critic = self.critic.parameters() if self.critic is not None else ()
        return list(dict.fromkeys([*self.actor.parameters(), *critic]))

    def state_dict(self) -> dict[str, Any]:
        """The state of each part, and the plain numbers that the actor holds, which may be annealed."""
        parts = {name: part.state_dict() for name, part in vars(self).items() if isinstance(part, nn.Module)}
        return {"parts": parts, "numbers": numbers(self.actor)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`.

        Raises:
            ValueError: it is the state of other parts.
        """
        parts = {name: part for name, part in vars(self).items() if isinstance(part, nn.Module)}
        if parts.keys() != state["parts"].keys():
            raise ValueError(f"it holds {', '.join(state['parts'])}; this agent has {', '.join(parts)}")
        for name, part in parts.items():
            load_part(part, state["parts"][name])
        set_numbers(self.actor, state["numbers"])


def load_part(part: nn.Module, state: dict[str, Any]) -> None:
    """``part.load_state_dict(state)``; TensorDict's parameters would take tensors of other shapes, broadcast."""
    for name, own in part.state_dict().items():
        if torch.is_tensor(own) and torch.is_tensor(x := state.get(name)) and own.shape != x.shape:
            raise ValueError(f"{name} is {tuple(x.shape)} there and {tuple(own.shape)} here")
    part.load_state_dict(state)


def numbers(module: nn.Module) -> dict[str, Any]:
    """The numbers that a module's parts hold as plain attributes, by their path."""
    return {
        f"{path}.{name}": value
        for path, part in module.named_modules()
        for name, value in vars(part).items()
        if isinstance(value, bool | int | float) and name != "training"
    }


def set_numbers(module: nn.Module, saved: dict[str, Any]) -> None:
    """Gives the parts of a module the numbers that they had when they were saved."""
    for name in saved.keys() & (now := numbers(module)).keys():
        if now[name] != saved[name]:
            path, _, attribute = name.rpartition(".")
            setattr(module.get_submodule(path), attribute, saved[name])


@contextlib.contextmanager
def as_built(agent: Agent) -> Iterator[None]:
    """A state that is loaded in this block brings what was learned; the agent's settings stay as they were built.

    Those are the buffers that loss, estimator, explorer and controller hold besides networks, normalizers and scales
    (coefficients, sizes of noise), and the actor's plain numbers.
    """
    learned = {id(x) for owner in (agent.actor, agent.critic, agent.normalizer, agent.scale) for x in _modules(owner)}
    owners = (agent.loss, agent.advantage, agent.explorer, agent.controller)
    others = [part for owner in owners for part in _modules(owner) if id(part) not in learned]
    buffers = [(x, x.clone()) for part in others if not _is_layer(part) for x in part.buffers(recurse=False)]
    plain = numbers(agent.actor)
    yield
    for x, value in buffers:
        x.copy_(value)
    set_numbers(agent.actor, plain)


def _modules(owner: Any) -> list[nn.Module]:
    return list(owner.modules()) if isinstance(owner, nn.Module) else []


def _is_layer(part: nn.Module) -> bool:
    """Whether it is torch's own, or TensorDict's: the networks of a loss, and their targets."""
    return type(part).__module__.partition(".")[0] in ("torch", "tensordict")


def rebuild(run_dir: Path, make: Callable[..., Agent] | None, trust: bool) -> tuple[Agent, RunArgs, Any]:
    """Agent, settings and an environment of a run, from its recipe's ``agent(args, env)`` and its settings."""
    make = make or _makes(run_dir, trust)
    hints = [hint for name, hint in typing.get_type_hints(make).items() if name != "return"]
    args = saved_args(hints[0] if hints and issubclass(hints[0], RunArgs) else RunArgs, run_dir)
    check_imports(args, trust)
    env = args.make_env(num_envs=1, seed=args.seed)
    try:
        name = vector_of(env).env_id
        played = read_config(run_dir).get("environment", name)
        if played != name:
            raise UserError(
                f"{run_dir} was evaluated on {played}, its settings give {name}: make that environment in its "
                "recipe's Args.make_env, which every command calls"
            )
        with seeding.preserved_rng():
            return make(args, env), args, env
    finally:
        env.close()


def _makes(run_dir: Path, trust: bool) -> Callable[..., Agent]:
    """The function ``agent`` of the recipe that wrote a run directory; another's file runs only where it is trusted."""
    config = read_config(run_dir)
    name, file = config["recipe"], config.get("file")
    if file is None and name not in [*recipes.names(), *recipes.variants()]:
        raise UserError(
            f"{run_dir} is a run of {name}, no recipe of pgkit: load_policy(..., agent=) takes its function"
        )
    if file is not None and not trust:
        raise UserError(f"{run_dir} is a run of {file}, which would be run: --trust (trust=True) where you trust it")
    file = file and str(run_dir / file)  # of a policy folder, the recipe that lies in it
    if file is not None and not Path(file).is_file():
        raise UserError(
            f"{run_dir} is a run of {file}, which is not there: put it back, or give load_policy(..., agent=)"
        )
    if file is not None and digest(file) != config.get("file_sha256"):
        logging.getLogger("pgkit").warning("%s has changed since the run: what it builds may act otherwise", file)
    module = recipes.load(Path(file) if file else recipes.find(name))
    if "agent" not in vars(module):
        raise UserError(f"{module.__file__} has no function agent(args, env) to build what {run_dir} trained")
    return module.agent


def load_agent(
    run_dir: str | Path,
    which: Which | None = None,
    *,
    agent: Callable[..., Agent] | None = None,
    trust: bool = False,
) -> Agent:
    """The agent of a run with what it learned: actor, critics, loss, normalizers.

    Args:
        run_dir: the run directory.
        which: the checkpoint; None: ``best`` by ``eval/mean_reward`` where there is one, else ``latest``.
        agent: the recipe's function ``agent(args: Args, env)``; by default that of the shipped recipe.
        trust: run the recipe file and import the modules that ``config.json`` names.

    Raises:
        UserError: there is no such checkpoint, it is damaged or another recipe's, or it would run code.
    """
    return restored(Path(run_dir), which, agent, trust)[0]


def restored(
    run_dir: Path, which: Which | None, make: Callable[..., Agent] | None, trust: bool, only_actor: bool = False
) -> tuple[Agent, RunArgs, Any, int]:
    """The agent of a run, its settings, an environment with its specs, and the frames of the checkpoint."""
    read_config(run_dir)
    folder = run_dir / "checkpoints"
    which = which or ("best" if (folder / "best.pt").exists() else "latest")
    if which == "best" and not (folder / "best.pt").exists() and (folder / "latest.pt").exists():
        raise UserError(f"{run_dir} has no evaluation yet, so no best policy: ask for the latest (--which latest)")
    saved = checkpoint.load(folder / f"{which}.pt")
    built, args, env = rebuild(run_dir, make, trust)
    with checkpoint.damage(run_dir):
        state = saved["states"]["agent"]
        if only_actor:
            built, state = Agent(built.actor), {**state, "parts": {"actor": state["parts"]["actor"]}}
        checkpoint.restore({"agent": built}, {"agent": state}, folder / f"{which}.pt")
    return built, args, env, saved["frames"]
