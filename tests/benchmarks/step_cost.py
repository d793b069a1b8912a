"""One PPO minibatch step, one advantage and one collected frame, taken apart.

    python tests/benchmarks/step_cost.py --parts step advantage frame

64 rows, 17 observations, 6 actions, 2x64 tanh nets, Adam with gradient clipping; GAE on [8, 256];
HalfCheetah-v5 with 8 envs. Everything runs in one process on `--threads` threads (default 1).
"""

import gc
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import contest
import gymnasium as gym
import numpy as np
import torch
import torchrl_parts
import tyro
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.objectives.value import GAE

from pgkit import advantages, collectors, envs, losses, modules
from pgkit.checks import LossView
from pgkit.updates import GradientStep
from pgkit.updates.step import grads_of, metrics_of

ENV_ID, NUM_ENVS, STEPS, ROWS, OBSERVATION, ACTION = "HalfCheetah-v5", 8, 256, 64, 17, 6


@dataclass
class Options:
    """What to take apart."""

    parts: tuple[Literal["step", "advantage", "frame"], ...] = ("step", "advantage", "frame")
    """Which tables to print."""
    calls: int = 1000
    """Timed calls of a step; rows that take longer do fewer."""
    rollouts: int = 5
    """Timed rollouts of a collector."""
    threads: int = 1
    """torch's threads."""
    json: str | None = None
    """Write the figures to this file."""


def agent() -> tuple[Any, Any]:
    """pgkit's actor and critic for the env of the contest."""
    env = envs.make(ENV_ID)
    return modules.gaussian_actor(env, hidden=(64, 64)), modules.state_value(env, hidden=(64, 64))


def fake_rollout(actor: Any) -> TensorDict:
    """A rollout [8, 256] of random numbers, actions sampled from the policy, two episode ends."""
    shape = (NUM_ENVS, STEPS)
    done = torch.zeros(*shape, 1, dtype=torch.bool)
    done[0, 100], done[3, 200] = True, True
    following = {"observation": torch.randn(*shape, OBSERVATION), "reward": torch.randn(*shape, 1)}
    following |= {"done": done, "truncated": done.clone(), "terminated": torch.zeros_like(done)}
    rollout = TensorDict({"observation": torch.randn(*shape, OBSERVATION), "next": following}, shape)
    with torch.no_grad():
        sample = actor(rollout.select("observation"))
    return rollout.update(sample.select("action", "action_log_prob"))


def steps(calls: int) -> dict[str, float]:
    """Milliseconds of one minibatch step: gather, loss, gradient, clip, Adam."""
    results = {}
    actor, critic = agent()
    rollout = advantages.GAE(critic, gamma=0.99, lmbda=0.95)(fake_rollout(actor))
    index = torch.randperm(NUM_ENVS * STEPS)[:ROWS]
    for compiled in (True, False):
        how = "compiled" if compiled else "eager"
        for name, make in (("pgkit loss", pgkit_loss), ("TorchRL ClipPPOLoss", torchrl_parts.ppo_loss)):
            loss = make(*agent())
            step = pgkit_step(loss, rollout, index, compiled)
            results[f"{name}, pgkit's step, {how}"] = contest.milliseconds(partial(step, index), calls, warmup=20)
        loss = torchrl_parts.ppo_loss(*agent())
        update, flat = torchrl_parts.ppo_update(loss, compiled=compiled), rollout.reshape(-1)
        name = f"TorchRL ClipPPOLoss, TorchRL's way, {'torch.compile(update)' if compiled else how}"
        results[name] = contest.milliseconds(lambda: update(flat[index]), calls // 4, warmup=20)  # noqa: B023
    return results


def pgkit_loss(actor: Any, critic: Any) -> losses.ClipPPOLoss:
    """The same loss as `torchrl_parts.ppo_loss`, pgkit's."""
    return losses.ClipPPOLoss(actor, critic, clip_epsilon=0.2, critic_coeff=0.5, entropy_bonus=False)


def pgkit_step(loss: Any, rollout: TensorDict, index: torch.Tensor, compiled: bool) -> Callable[..., Any]:
    """pgkit's step for any loss, on the rollout as OnPolicyUpdate hands it to that step."""
    flat = rollout.select(*LossView(loss).readable(rollout)).reshape(-1).contiguous()
    names = [key for key, value in loss(flat[:ROWS]).items() if value.numel() == 1]
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    params = optimizer.param_groups[0]["params"]

    def gradients(data: Any, index: torch.Tensor) -> tuple[Any, Any]:
        out = loss(data[index])
        grads = grads_of(out, params)
        return metrics_of(out, names, grads[0]), grads

    mode = "on" if compiled else "off"
    return GradientStep(gradients, optimizer, names, watch={"the loss": loss}, max_grad_norm=0.5, mode=mode).bind(
        flat, index
    )


def gae(calls: int) -> dict[str, float]:
    """Milliseconds of GAE on [8, 256], critic included."""
    actor, critic = agent()
    rollout = fake_rollout(actor)
    both = {
        "pgkit GAE": advantages.GAE(critic, gamma=0.99, lmbda=0.95),
        "TorchRL GAE": GAE(gamma=0.99, lmbda=0.95, value_network=critic),
    }
    with torch.no_grad():
        return {
            name: contest.milliseconds(lambda block=block: block(rollout.copy()), calls // 5)
            for name, block in both.items()
        }


def frames(rollouts: int) -> dict[str, float]:
    """Microseconds of one collected frame."""
    results = {"Gymnasium stepping alone, random actions": gymnasium_frame(rollouts)}
    for workers in (1, 2):
        env = envs.make(ENV_ID, num_envs=NUM_ENVS, seed=1, workers=workers)
        collector = collectors.VectorCollector(env, agent()[0], frames_per_batch=NUM_ENVS * STEPS, total_frames=10**12)
        results[f"pgkit VectorCollector, {workers} worker{'s' * (workers > 1)}"] = frame(collector, rollouts)
        collector.shutdown()
    env = torchrl_parts.make_env(ENV_ID, NUM_ENVS)
    collector = Collector(env, torchrl_parts.ppo_nets(env)[0], frames_per_batch=NUM_ENVS * STEPS, total_frames=-1)
    results["TorchRL Collector, SerialEnv"] = frame(collector, rollouts)
    collector.shutdown()
    return results


def gymnasium_frame(rollouts: int) -> float:
    env = [gym.make(ENV_ID, disable_env_checker=True) for _ in range(NUM_ENVS)]
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, NUM_ENVS, ACTION)).astype(np.float32)

    def collect() -> None:
        for step in actions:
            for one, action in zip(env, step, strict=True):
                if any(one.step(action)[2:4]):
                    one.reset()

    for index, one in enumerate(env):
        one.reset(seed=index)
    return 1e3 * contest.milliseconds(collect, rollouts, warmup=1) / (NUM_ENVS * STEPS)


def frame(collector: Any, rollouts: int) -> float:
    """Microseconds a frame of a collector, rollouts included whole."""
    iterator = iter(collector)
    return 1e3 * contest.milliseconds(lambda: next(iterator), rollouts, warmup=3) / (NUM_ENVS * STEPS)


def show(title: str, unit: str, rows: dict[str, float], rate: Callable[[float], str]) -> None:
    """One Markdown table."""
    print(f"\n| {title} | {unit} | a second |\n|---|---|---|")
    for name, value in rows.items():
        print(f"| {name} | {value:.2f} | {rate(value)} |")


if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    print(f"{contest.machine()['text']}; {options.threads} thread(s)")
    result: dict[str, Any] = {"machine": contest.machine(), "threads": options.threads}
    if "frame" in options.parts:  # before anything that leaves memory behind in this process
        result["frame_us"] = frames(options.rollouts)
        show("one collected frame", "microseconds", result["frame_us"], lambda us: f"{1e6 / us:,.0f} frames")
        gc.collect()
    if "advantage" in options.parts:
        result["advantage_ms"] = gae(options.calls)
        show("GAE on [8, 256]", "ms", result["advantage_ms"], lambda ms: f"{1e3 / ms:,.0f}")
    if "step" in options.parts:
        result["step_ms"] = steps(options.calls)
        show("one minibatch step, 64 rows", "ms", result["step_ms"], lambda ms: f"{1e3 / ms:,.0f}")
    contest.write(options.json, result)
