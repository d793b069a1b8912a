"""A trained policy from its files: a run directory, or a policy folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from pgkit.errors import UserError
from pgkit.run.agent import Agent, Which, load_part, rebuild, restored, set_numbers
from pgkit.run.config import read_json
from pgkit.run.exported import needs
from pgkit.run.policy import Policy, describe_env

WEIGHTS, ABOUT = "policy.safetensors", "policy.json"  # of a policy folder


def load_policy(
    run_dir: str | Path,
    which: Which = "best",
    *,
    agent: Callable[..., Agent] | None = None,
    trust: bool = False,
) -> Policy:
    """The policy of a run: ``best`` by ``eval/mean_reward``, or ``latest``; arguments as in :func:`load_agent`.

    A policy folder, which :func:`export` writes, holds one policy: ``which`` says nothing there.
    """
    run_dir = Path(run_dir)
    if os.path.isfile(run_dir / ABOUT):  # False also for a name that no file can have
        return _from_folder(run_dir, agent, trust)
    built, args, env, frames = restored(run_dir, which, agent, trust, only_actor=True)
    return Policy(built.actor.eval(), args.make_env, **describe_env(env), frames=frames, args=args)


def _from_folder(folder: Path, make: Callable[..., Agent] | None, trust: bool) -> Policy:
    safetensors, about = needs("safetensors.torch", "export"), read_json(folder / ABOUT)
    built, args, env = rebuild(folder, make, trust)
    try:
        load_part(built.actor, safetensors.load_file(folder / WEIGHTS))
        set_numbers(built.actor, about["numbers"])
        frames = int(about["frames"])
    except Exception as error:  # a reader may stumble over forged bytes in any way
        raise UserError(f"{folder / WEIGHTS} does not fit the policy: {str(error).splitlines()[0]}") from error
    return Policy(built.actor.eval(), args.make_env, **describe_env(env), frames=frames, args=args)
