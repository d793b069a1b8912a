"""Soft actor-critic and its descendants, for continuous actions: critics, value head, replay and pace are flags.

The defaults are the MuJoCo settings of SAC; tuned values for other environments are in ``PRESETS`` below, the settings
that make REDQ, TQC, DroQ and CrossQ in ``VARIANTS``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torchrl.data import LazyTensorStorage
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from pgkit import collectors, controllers, data, heads, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of SAC."""

    env_id: str = "HalfCheetah-v5"
    """Gymnasium id, or dm_control/<domain>-<task>-v0."""
    variant: str = ""
    """Start from the settings of redq, tqc, droq or crossq."""
    critic: Literal["mlp", "layernorm", "simba", "crossq", "droq"] = "mlp"
    """Perceptrons; with layer norm; with residual blocks and normalized observations; with batch renorm and a joint
    forward pass in place of target networks; with dropout and layer norm."""
    value_head: Literal["scalar", "quantile", "categorical"] = "scalar"
    """Critics learn the expected return, quantiles of the return, or the expected return as a classification."""
    num_critics: int = run.setting(2, low=1)
    """Critics."""
    subset: int | None = None
    """Critics that make the target, drawn anew for each update; None: all."""
    actor_value: Literal["min", "mean"] = "min"
    """The actor maximizes the least of the critics, or their mean."""
    dropout: float = run.setting(0.01, low=0, high=0.99)
    """Probability of a zero in the hidden layers of a droq critic."""
    atoms: int = run.setting(25, low=1)
    """Quantiles of each critic."""
    drop_atoms: int = 2
    """Largest atoms left out of the target, for each critic."""
    bins: int = run.setting(101, low=1)
    """Classes of a categorical critic."""
    value_range: tuple[float, float] = (-1_000.0, 1_000.0)
    """Least and largest discounted return of a categorical critic."""
    total_frames: int = 1_000_000
    """Env steps to train for, all envs together; with action_repeat, decisions."""
    num_envs: int = 1
    """Envs stepped side by side."""
    threads: int = 0
    """Threads that PyTorch uses in this process; 0: 1 or 2, whichever a measurement at the start finds faster."""
    steps: int = run.setting(16, low=1)
    """Steps each env takes before as many updates; 1 is the papers' schedule."""
    overlap: bool = False
    """Collect the next rollout in other processes while this one updates: its weights are one update old."""
    random_frames: int = run.setting(1_000, low=0)
    """Frames with random actions before updates begin; a run no longer than that has a batch of them."""
    batch_size: int = run.setting(256, low=1)
    """Rows of a batch."""
    updates_per_step: float = run.setting(1.0, low=0)
    """Gradient steps for each frame."""
    actor_delay: int = run.setting(1, low=1)
    """The actor and the temperature learn at every so many-th gradient step."""
    learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the actor."""
    q_learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the critics."""
    alpha_learning_rate: float = run.setting(3e-4, low=0)
    """Adam's step size for the temperature."""
    beta1: float = run.setting(0.9, low=0, high=0.9999)
    """Adam's first decay rate."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.005, low=0, high=1)
    """Share of the critics that their targets take over at each gradient step."""
    alpha: float | None = run.setting(None, low=0)
    """A fixed temperature; None trains it."""
    alpha_init: float = run.setting(1.0, low=1e-8)
    """The trained temperature at the start."""
    target_entropy: float | None = None
    """Entropy that the temperature holds, of actions scaled to [-1, 1]; None is minus the number of dimensions."""
    buffer_size: int = run.setting(1_000_000, low=1)
    """Frames that the replay buffer keeps."""
    buffer_dir: Path | None = run.setting(None, on_resume=True)
    """Keep the replay buffer in files of this folder (a buffer beyond RAM); None keeps it in memory."""
    n_step: int = run.setting(1, low=1)
    """Length of the returns that the critics learn."""
    replay: Literal["uniform", "prioritized"] = "uniform"
    """Draw frames uniformly, or in proportion to the critics' errors."""
    save_buffer: bool = run.setting(False, on_resume=True)
    """Save the replay buffer beside each checkpoint, so that a resumed run goes on bit for bit."""
    hidden: tuple[int, ...] = run.setting((256, 256), low=1, high=2**16)
    """Sizes of the hidden layers; for simba, one residual block each, as wide as the last."""
    critic_hidden: tuple[int, ...] | None = run.setting(None, low=1, high=2**16)
    """Those of the critics; None: as the actor's."""
    log_every: int = run.setting(1_000, low=1, on_resume=True)
    """A row of metrics every so many frames."""


PRESETS = {
    "Pendulum-*": dict(
        total_frames=20_000, eval_every=5_000, learning_rate=1e-3, q_learning_rate=1e-3, alpha_learning_rate=1e-3
    ),
    "HalfCheetah-*": dict(learning_rate=1e-3, q_learning_rate=1e-3, alpha_learning_rate=1e-3),
    "dm_control/*": dict(total_frames=500_000, action_repeat=2),
    "dmc:*": dict(total_frames=500_000, action_repeat=2),
}

SEARCH = {
    "learning_rate": (1e-4, 3e-3, "log"),
    "q_learning_rate": (1e-4, 3e-3, "log"),
    "batch_size": [128, 256, 512],
    "tau": (0.002, 0.05, "log"),
    "gamma": [0.98, 0.99, 0.995],
    "critic": ["mlp", "layernorm", "crossq"],
    "actor_delay": (1, 3),
}

VARIANTS = {
    "redq": dict(num_critics=10, subset=2, actor_value="mean", steps=1, updates_per_step=20.0, actor_delay=20),
    "droq": dict(critic="droq", actor_value="mean", steps=1, updates_per_step=20.0, actor_delay=20),
    "tqc": dict(value_head="quantile", num_critics=5, actor_value="mean"),
    "crossq": dict(
        critic="crossq", random_frames=5_000, actor_delay=3, beta1=0.5,
        learning_rate=1e-3, q_learning_rate=1e-3, alpha_learning_rate=1e-3,
    ),
}  # fmt: skip


def networks(args: Args, env: EnvBase) -> tuple[ProbabilisticActor, modules.QValue, Any]:
    """The actor, the critics, and what normalizes the observations of both."""
    bodies = {
        "simba": lambda sizes: partial(modules.simba, width=sizes[-1], blocks=len(sizes)),
        "crossq": lambda sizes: partial(modules.batch_renorm_mlp, hidden=sizes),
    }
    hidden, body = args.critic_hidden or args.hidden, bodies.get(args.critic)
    normalizer = modules.ObsNormalizer(env) if args.critic == "simba" else None
    encoder = modules.Encoder(env, body(args.hidden)) if body else None
    actor = modules.tanh_normal_actor(env, args.hidden, encoder=encoder, normalizer=normalizer)
    layers = {
        "norm": modules.EnsembleLayerNorm if args.critic in ("layernorm", "droq") else None,
        "dropout": args.dropout if args.critic == "droq" else 0.0,
        "body": body(hidden) if body else None,
    }
    head = {
        "scalar": None,
        "quantile": heads.Quantiles(args.atoms, args.drop_atoms),
        "categorical": heads.Bins(*args.value_range, size=args.bins),
    }[args.value_head]
    return actor, modules.q_value(env, args.num_critics, hidden, **layers, head=head, normalizer=normalizer), normalizer


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Networks, temperature and loss."""
    actor, critics, normalizer = networks(args, env)
    if args.alpha is not None:
        temperature = controllers.FixedTemperature(args.alpha)
    else:
        spec: Any = env.action_spec_unbatched
        unit = ((spec.space.high - spec.space.low) / 2).log().sum().item()  # of actions' densities, against [-1, 1]
        target_entropy = -spec.shape.numel() if args.target_entropy is None else args.target_entropy
        temperature = controllers.Temperature(target_entropy + unit, args.alpha_init)
    make_loss = losses.CrossQLoss if args.critic == "crossq" else losses.SACLoss
    settings = {"subset": args.subset, "actor_value": args.actor_value, "gamma": args.gamma}
    loss = make_loss(actor, critics, temperature=temperature, **settings)
    return run.Agent(actor, loss, critics, normalizer=normalizer, controller=temperature)


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe=args.variant or "sac") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        random_frames = args.random_frames if args.random_frames < args.total_frames else args.batch_size
        sampler = data.Prioritized() if args.replay == "prioritized" else None
        storage = data.in_files(args.buffer_dir) if args.buffer_dir else LazyTensorStorage
        buffer = data.ReplayBuffer(env, args.buffer_size, n_steps=args.n_step, sampler=sampler, storage=storage)
        groups = [
            {"params": list(built.actor.parameters()), "lr": args.learning_rate},
            {"params": list(built.critic.parameters()), "lr": args.q_learning_rate},
            {"params": list(built.controller.parameters()), "lr": args.alpha_learning_rate},
        ]
        update = updates.OffPolicyUpdate(
            loss=built.loss,
            buffer=buffer,
            optimizer=torch.optim.Adam([g for g in groups if g["params"]], betas=(args.beta1, 0.999)),
            batch_size=args.batch_size,
            updates_per_step=args.updates_per_step,
            actor_delay=args.actor_delay,
            tau=args.tau,
            learning_starts=max(random_frames, args.batch_size),
            total_frames=args.total_frames,
            compile=args.compile,
        )
        make_collector = collectors.AsyncCollector if args.overlap else collectors.VectorCollector
        frames = {"frames_per_batch": args.num_envs * args.steps, "total_frames": args.total_frames}
        collector = make_collector(env, built.actor, **frames, init_random_frames=random_frames, compile=args.compile)

        replay = data.BesideCheckpoint(buffer, log.dir / "checkpoints" / "buffer.pt", save=args.save_buffer)
        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector, replay=replay)
        for rollout in collector:
            if built.normalizer is not None:
                built.normalizer.update(rollout["observation"])
            metrics = update(rollout)
            if args.overlap:
                metrics["policy_lag"] = collector.lag
            log.step(collector.frames, rollout, metrics, every=args.log_every)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS, variants=VARIANTS)
