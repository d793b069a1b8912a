"""Ape-X SAC on Ray: many explorers fill a prioritized replay in shards, one learner reads from it without waiting.

For simulators that are slow beside the updates, or for many machines. The loss, the networks and the update are SAC's;
tuned values for some environments are in ``PRESETS`` below.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from pgkit import collectors, controllers, data, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of Ape-X SAC."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    explorers: int = run.setting(8, low=1, high=10_000, on_resume=True)
    """Actors that explore, each a process of Ray's."""
    ray_address: str | None = run.setting(None, on_resume=True)
    """Address of a Ray cluster to join (auto: one on this machine); None starts Ray on this machine."""
    total_frames: int = 1_000_000
    """Env steps to train for, all explorers together."""
    num_envs: int = 1
    """Envs that each explorer steps side by side."""
    steps: int = run.setting(32, low=1)
    """Steps of each env between two messages of an explorer; the last n_step of them have shorter returns."""
    frames_per_update: float | None = run.setting(None, above=0, on_resume=True)
    """Frames that the explorers may collect for each gradient step; None: as many as they can."""
    noise: tuple[float, float] = run.setting((0.5, 2.0), above=0)
    """The explorers' ladder: factors of the policy's deviation, of the first explorer and of the last."""
    random_frames: int = run.setting(1_000, low=0)
    """Frames with random actions, all explorers together."""
    shards: int = run.setting(2, low=1, high=1_000, on_resume=True)
    """Actors that the replay is spread over."""
    buffer_size: int = run.setting(1_000_000, low=1)
    """Frames that the replay keeps, all shards together."""
    request: int = run.setting(8, low=1)
    """Batches that the learner asks a shard for at once; their priorities go back together."""
    ahead: int = run.setting(2, low=1, on_resume=True)
    """Requests that are under way while the learner trains."""
    priority_alpha: float = run.setting(0.6, low=0)
    """How much the priorities count; 0 draws uniformly."""
    priority_beta: float = run.setting(0.4, low=0)
    """How far the importance weights correct for them."""
    publish_every: int = run.setting(64, low=1, on_resume=True)
    """Gradient steps between two versions of the explorers' weights."""
    batch_size: int = run.setting(256, low=1)
    """Rows of a batch."""
    learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for actor, critics and temperature."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.005, low=0, high=1)
    """Share of the critics that their targets take over at each gradient step."""
    alpha_init: float = run.setting(1.0, low=1e-8)
    """The temperature at the start."""
    n_step: int = run.setting(1, low=1)
    """Length of the returns that the critics learn."""
    hidden: tuple[int, ...] = run.setting((256, 256), low=1, high=2**16)
    """Sizes of the hidden layers."""
    log_every: int = run.setting(1_000, low=1, on_resume=True)
    """A row of metrics every so many frames."""


PRESETS = {
    "Pendulum-*": dict(total_frames=20_000, eval_every=5_000, learning_rate=1e-3, frames_per_update=1.0),
    "HalfCheetah-*": dict(learning_rate=1e-3),
}

SEARCH = {
    "learning_rate": (1e-4, 3e-3, "log"),
    "tau": (0.002, 0.05, "log"),
    "gamma": [0.98, 0.99, 0.995],
    "n_step": (1, 5),
    "priority_alpha": (0.3, 0.9),
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, temperature and loss."""
    actor, critics = modules.tanh_normal_actor(env, args.hidden), modules.q_value(env, 2, args.hidden)
    spec: Any = env.action_spec_unbatched
    unit = ((spec.space.high - spec.space.low) / 2).log().sum().item()  # of actions' densities, against [-1, 1]
    temperature = controllers.Temperature(unit - spec.shape.numel(), args.alpha_init)
    loss = losses.SACLoss(actor, critics, temperature=temperature, gamma=args.gamma)
    return run.Agent(actor, loss, critics, controller=temperature)


class Explorer:
    """What an explorer does: it collects with its own deviation, and says how wrong the critics were."""

    def __init__(self, args: Args, number: int, seed: int, frames: int) -> None:
        env = args.make_env(args.num_envs, seed)
        (low, high), last = args.noise, args.explorers - 1
        place = number / last if last else 0.5
        self.loss = (built := agent(args, env)).loss
        self.collector = collectors.VectorCollector(
            env,
            modules.ScaledExploration(built.actor, low ** (1 - place) * high**place),
            frames_per_batch=args.num_envs * args.steps,
            init_random_frames=max(args.random_frames - frames, 0) // args.explorers,
            compile="off",
        )
        self.rows = args.num_envs * args.steps
        self.recent = data.ReplayBuffer(env, 2 * self.rows, n_steps=args.n_step, final_rows=2 * self.rows)

    def __call__(self, weights: dict[str, Tensor]) -> TensorDictBase:
        """A rollout, with ``td_error`` for its first priorities."""
        self.loss.load_state_dict(weights)
        rollout = self.collector.rollout()
        self.recent.clear()
        self.recent.extend(rollout)
        self.recent.extend(rollout[:, :1])  # no successor: now the rollout's last step has its next observation
        batch = self.recent.gather(self.loss.gamma)(self.recent.data, torch.arange(self.rows))
        with torch.no_grad():
            self.loss(batch)
        return rollout.set("td_error", batch["td_error"].view(-1, len(rollout)).T)  # the replay's rows go by time


def shard(args: Args, number: int) -> data.ReplayBuffer:
    """One shard of the replay."""
    env = args.make_env(args.num_envs, args.seed)
    sampler = data.Prioritized(args.priority_alpha, args.priority_beta)
    size = max(args.buffer_size // args.shards, args.num_envs)
    return data.ReplayBuffer(env, size, n_steps=args.n_step, sampler=sampler, seed=args.seed + number)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="apex_sac") as log:
        env = args.make_env(args.num_envs, args.seed)
        with run.placed(args) as device:
            built = agent(args, env)
        collectors.connect(args.ray_address, args.explorers + args.shards)
        start = max(args.random_frames, args.batch_size)
        replay = data.RayReplay(
            lambda number: shard(args, number),
            shards=args.shards,
            batch_size=args.batch_size,
            batches=args.request,
            ahead=args.ahead,
            gamma=args.gamma,
            least=start // args.shards,
            device=device,
        )
        update = updates.OffPolicyUpdate(
            built.loss,
            replay,
            torch.optim.Adam([*built.parameters(), *built.controller.parameters()], lr=args.learning_rate),
            batch_size=args.batch_size,
            tau=args.tau,
            learning_starts=start,
            total_frames=args.total_frames,
            compile=args.compile,
        )
        explorers = collectors.RayExplorers(
            lambda number, seed, frames: Explorer(args, number, seed, frames),
            args.explorers,
            replay,
            frames_per_call=args.num_envs * args.steps,
            total_frames=args.total_frames,
            frames_per_update=args.frames_per_update,
            seed=args.seed,
        )
        log.track(agent=built, eval_env=args.make_env, update=update, collector=explorers)
        learn(args, log, built, replay, update, explorers)
        explorers.shutdown()
        replay.shutdown()


def learn(args: Args, log: run.Run, built: run.Agent, replay: Any, update: Any, explorers: Any) -> None:
    """Trains until the explorers have collected ``total_frames``."""
    publish_at = update.updates
    while explorers.frames < args.total_frames:
        if update.updates >= publish_at:
            explorers.publish(built.loss.state_dict(), update.updates)
            publish_at = update.updates + args.publish_every
        learns = replay.ready()
        rollout = explorers.collect(update.updates if learns else None)
        metrics = update.train(args.request) if learns else {}
        if metrics:
            metrics |= {"replay/priority_age": replay.age, "replay/frames": len(replay)}
            metrics["updates_per_frame"] = update.updates / max(explorers.frames, 1)
        log.step(explorers.frames, rollout, metrics, every=args.log_every)


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
