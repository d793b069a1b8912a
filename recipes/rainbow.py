"""Rainbow: categorical values, dueling noisy network, double target, n-step returns, prioritized replay.

The loss is TorchRL's DistributionalDQNLoss as it is; replay, collector and update are pgkit's. Tuned values for
CartPole are in ``PRESETS`` below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import DistributionalQValueActor, NoisyLinear
from torchrl.objectives import DistributionalDQNLoss

from pgkit import collectors, controllers, data, modules, run, updates
from pgkit.errors import UserError


@dataclass
class Args(run.RunArgs):
    """Settings of Rainbow."""

    env_id: str = "CartPole-v1"
    """Gymnasium id with one discrete action."""
    num_envs: int = 4
    """Envs stepped side by side."""
    steps: int = run.setting(1, low=1)
    """Steps each env takes between updates; the network's noise is drawn anew for each rollout."""
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
    gamma: float = run.setting(0.99, low=0, high=1)
    """Discount."""
    tau: float = run.setting(0.005, low=0, high=1)
    """Share of the network that its target takes over at each gradient step."""
    atoms: int = run.setting(51, low=1)
    """Values that the distribution of the return is spread over."""
    v_min: float = -10.0
    """The least of them."""
    v_max: float = 100.0
    """The largest of them: above any discounted return that is possible."""
    noise: float = run.setting(0.5, low=0)
    """Initial standard deviation of the noisy weights."""
    n_step: int = run.setting(3, low=1)
    """Length of the returns that the network learns."""
    priority_alpha: float = run.setting(0.5, low=0)
    """How much priorities count in the draws; 0 draws uniformly."""
    priority_beta: float = run.setting(0.4, low=0)
    """How far importance weights correct for that at the start; it rises to 1."""
    buffer_size: int = run.setting(100_000, low=1)
    """Frames that the replay buffer keeps."""
    save_buffer: bool = run.setting(False, on_resume=True)
    """Save the replay buffer beside each checkpoint, so that a resumed run goes on bit for bit."""
    hidden: tuple[int, ...] = run.setting((128, 128), low=1, high=2**16)
    """Sizes of the hidden layers; the last is a noisy one in each stream."""
    log_every: int = run.setting(1_000, low=1, on_resume=True)
    """A row of metrics every so many frames."""


PRESETS = {"CartPole-*": dict(total_frames=100_000, eval_every=10_000, n_step=10)}

SEARCH = {
    "learning_rate": (1e-4, 3e-3, "log"),
    "batch_size": [32, 64, 128],
    "updates_per_step": [0.25, 0.5, 1.0],
    "tau": (0.001, 0.05, "log"),
    "n_step": (1, 10),
    "priority_alpha": (0.3, 0.8),
}


class DuelingNoisyNet(nn.Module):
    """Log-probabilities of the return's atoms, by a value and an advantage stream: ``[*B, atoms, actions]``."""

    def __init__(self, features: int, actions: int, atoms: int, hidden: Sequence[int], noise: float) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for size in hidden[:-1]:
            layers += [nn.Linear(features, size), nn.ReLU()]
            features = size
        self.body, self.sizes = nn.Sequential(*layers), (atoms, actions)

        def stream(outputs: int) -> nn.Sequential:
            noisy = partial(NoisyLinear, std_init=noise, use_exploration_type=False)  # noise in training mode only
            return nn.Sequential(noisy(features, hidden[-1]), nn.ReLU(), noisy(hidden[-1], outputs))

        self.value, self.advantage = stream(atoms), stream(atoms * actions)

    def forward(self, observation: Tensor) -> Tensor:
        x = self.body(observation)
        advantage = self.advantage(x).unflatten(-1, self.sizes)
        return (self.value(x).unsqueeze(-1) + advantage - advantage.mean(-1, keepdim=True)).log_softmax(-2)


def agent(args: Args, env: EnvBase) -> run.Agent:
    """Network and loss."""
    actions = getattr(env.action_spec_unbatched.space, "n", None)
    if actions is None:
        raise UserError(f"rainbow needs one discrete action, '{args.env_id}' has another action space: use sac")
    if args.v_min >= args.v_max:
        raise UserError(f"--v-min {args.v_min:g} --v-max {args.v_max:g}: give a least return below the largest")
    shape = env.observation_spec_unbatched["observation"].shape
    if len(shape) > 2:
        raise UserError(f"rainbow reads vectors, an observation of '{args.env_id}' is {list(shape)}: flatten it")
    sizes = (shape.numel(), actions)
    net = DuelingNoisyNet(*sizes, args.atoms, args.hidden, args.noise)
    net = nn.Sequential(modules.FlatMatrix(), net) if len(shape) == 2 else net
    actor = DistributionalQValueActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["action_value"]),
        support=torch.linspace(args.v_min, args.v_max, args.atoms),
        action_space="categorical",
    )
    return run.Agent(actor, DistributionalDQNLoss(actor, gamma=args.gamma, delay_value=True))


def draw_noise(actor: nn.Module) -> None:
    """Draws the noise of all weights anew; in evaluation mode there is none."""
    for module in actor.modules():
        if isinstance(module, NoisyLinear):
            module.reset_noise()


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="rainbow") as log:
        env = args.make_env(args.num_envs, args.seed, args.workers)
        with run.placed(args):
            built = agent(args, env)
        sampler = data.Prioritized(args.priority_alpha, args.priority_beta)
        buffer = data.ReplayBuffer(env, args.buffer_size, n_steps=args.n_step, sampler=sampler)
        update = updates.OffPolicyUpdate(
            loss=built.loss,
            buffer=buffer,
            optimizer=torch.optim.Adam(built.parameters(), lr=args.learning_rate, eps=1e-4),
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
            built.actor,
            frames_per_batch=args.num_envs * args.steps,
            total_frames=args.total_frames,
            init_random_frames=args.random_frames,
            compile=args.compile,
        )

        replay = data.BesideCheckpoint(buffer, log.dir / "checkpoints" / "buffer.pt", save=args.save_buffer)
        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector, replay=replay)
        beta = controllers.linear(args.priority_beta, 1.0)
        for rollout in collector:
            draw_noise(built.actor)
            sampler.set_beta(beta(collector.frames / args.total_frames))
            metrics = update(rollout)
            log.step(collector.frames, rollout, metrics, every=args.log_every)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args, PRESETS)
