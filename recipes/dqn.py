"""Deep Q-learning with a double target and annealed epsilon-greedy exploration, for discrete actions.

The loss is TorchRL's DQNLoss as it is; replay, collector and compiled update are pgkit's. Values for CartPole and Atari
are in ``PRESETS`` below.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict.nn import TensorDictSequential
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss

from pgkit import collectors, data, modules, run, updates
from pgkit.errors import UserError


@dataclass
class Args(run.RunArgs):
    """Settings of DQN."""

    env_id: str = "CartPole-v1"
    """Gymnasium id with one discrete action, or ALE/<game>-v5."""
    num_envs: int = 4
    """Envs stepped side by side."""
    steps: int = run.setting(1, low=1)
    """Steps each env takes between updates."""
    random_frames: int = run.setting(1_000, low=0)
    """Frames with random actions at the start; updates begin after them."""
    batch_size: int = run.setting(64, low=1)
    """Rows of a batch."""
    updates_per_step: float = run.setting(0.25, low=0)
    """Gradient steps for each frame."""
    learning_rate: float = run.setting(5e-4, low=0)
    """Adam's step size."""
    max_grad_norm: float | None = run.setting(10.0, above=0)
    """Bound of the gradient's norm; None is none."""
    loss_function: Literal["smooth_l1", "l2"] = "smooth_l1"
    """Distance of value and target."""
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.005, low=0, high=1)
    """Share of the network that its target takes over at each gradient step."""
    double: bool = True
    """Choose the next action by the trained network, and value it by the target (van Hasselt et al., 2016)."""
    epsilon_end: float = run.setting(0.05, low=0, high=1)
    """Share of random actions in the end; it begins at 1."""
    epsilon_frames: int = run.setting(20_000, low=0)
    """Frames over which that share falls, in a straight line."""
    buffer_size: int = run.setting(100_000, low=1)
    """Frames that the replay buffer keeps."""
    n_step: int = run.setting(1, low=1)
    """Length of the returns that the network learns."""
    replay: Literal["uniform", "prioritized"] = "uniform"
    """Draw frames uniformly, or in proportion to the network's errors."""
    save_buffer: bool = run.setting(False, on_resume=True)
    """Save the replay buffer beside each checkpoint, so that a resumed run goes on bit for bit."""
    hidden: tuple[int, ...] = run.setting((128, 128), low=1, high=2**16)
    """Sizes of the hidden layers; of images, after an encoder."""
    log_every: int = run.setting(1_000, low=1, on_resume=True)
    """A row of metrics every so many frames."""


PRESETS = {
    "CartPole-*": dict(total_frames=100_000, eval_every=10_000, n_step=10, batch_size=256, tau=0.01),
    "ALE/*": dict(
        total_frames=10_000_000, eval_every=500_000, eval_episodes=5, random_frames=80_000, batch_size=32,
        learning_rate=1e-4, buffer_size=1_000_000, epsilon_end=0.01, epsilon_frames=1_000_000, hidden=(),
    ),
}  # fmt: skip

SEARCH = {
    "learning_rate": (1e-4, 3e-3, "log"),
    "batch_size": [32, 64, 128],
    "updates_per_step": [0.25, 0.5, 1.0],
    "tau": (0.001, 0.05, "log"),
    "n_step": (1, 5),
    "epsilon_frames": [5_000, 20_000, 50_000],
}


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Network, loss and exploration."""
    actions = getattr(env.action_spec_unbatched.space, "n", None)
    if actions is None:
        raise UserError(f"dqn needs one discrete action, '{args.env_id}' has another action space: use sac or td3")
    shape, image = env.observation_spec_unbatched["observation"].shape, modules.image_encoder(env)
    if len(shape) > 2 and image is None:
        raise UserError(f"dqn reads vectors and images, an observation of '{args.env_id}' is {list(shape)}: flatten it")
    sizes = (shape.numel() if image is None else image.features, actions)
    net, first = modules.mlp(*sizes, args.hidden, torch.nn.ReLU), modules.FlatMatrix() if len(shape) == 2 else image
    net = net if first is None else torch.nn.Sequential(first, net)
    actor = QValueActor(net, in_keys=["observation"], action_space="categorical")
    settings = {"loss_function": args.loss_function, "double_dqn": args.double}
    loss = DQNLoss(actor, action_space="categorical", delay_value=True, **settings)
    loss.make_value_estimator(gamma=args.gamma)
    explore = EGreedyModule(env.action_spec, 1.0, args.epsilon_end, args.epsilon_frames)
    return run.Agent(actor, loss, explorer=TensorDictSequential(actor, explore))


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="dqn") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        explore = built.explorer[-1]
        buffer = data.ReplayBuffer(
            env,
            args.buffer_size,
            n_steps=args.n_step,
            sampler=data.Prioritized(alpha=0.3) if args.replay == "prioritized" else None,  # of squared errors: |.|^0.6
        )
        update = updates.OffPolicyUpdate(
            loss=built.loss,
            buffer=buffer,
            optimizer=torch.optim.Adam(built.parameters(), lr=args.learning_rate),
            batch_size=args.batch_size,
            updates_per_step=args.updates_per_step,
            tau=args.tau,
            learning_starts=max(args.random_frames, args.batch_size),
            max_grad_norm=args.max_grad_norm,
            total_frames=args.total_frames,
            compile=args.compile,
        )
        collector = collectors.VectorCollector(
            env,
            built.explorer,
            frames_per_batch=args.num_envs * args.steps,
            total_frames=args.total_frames,
            init_random_frames=args.random_frames,
            compile=args.compile,
        )

        replay = data.BesideCheckpoint(buffer, log.dir / "checkpoints" / "buffer.pt", save=args.save_buffer)
        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector, replay=replay)
        for rollout in collector:
            metrics = update(rollout)
            explore.step(rollout.numel())
            metrics["epsilon"] = float(explore.eps)
            log.step(collector.frames, rollout, metrics, every=args.log_every)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
