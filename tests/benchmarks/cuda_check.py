"""One step on a GPU, every way it can run, beside the CPU: times, equality, whole updates, memory. One table.

    python tests/benchmarks/cuda_check.py --device cuda

`cuda.sh` calls it with what a bare machine lacks. `--device cpu` rehearses it: what captures nothing says so.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import torch
import tyro
from tensordict import TensorDict

from pgkit import advantages, collectors, data, envs, losses, modules, updates
from pgkit.compiled import recorded

ENV_ID, NUM_ENVS, STEPS = "Pendulum-v1", 8, 256


@dataclass
class Options:
    """The CUDA check."""

    device: str = "cuda"
    """Where networks, replay and updates are."""
    calls: int = 200
    """Timed steps of each way."""
    frames: int = 16_384
    """Frames of PPO end to end; SAC takes an eighth."""
    rows: int = 4096
    """Rows of PPO's large minibatch."""


def ppo(device: str, minibatch: int = 64, compile: str = "on", width: int = 64) -> tuple[Any, Any, Any]:
    """Environment, actor and update."""
    torch.manual_seed(0)
    env, hidden = envs.make(ENV_ID, num_envs=NUM_ENVS, seed=1), (width, width)
    actor = modules.gaussian_actor(env, hidden=hidden).to(device)
    critic = modules.state_value(env, hidden=hidden).to(device)
    update = updates.OnPolicyUpdate(
        losses.ClipPPOLoss(actor, critic),
        advantages.GAE(critic, gamma=0.99, lmbda=0.95).to(device),
        torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=3e-4),
        epochs=4, minibatch_size=minibatch, compile=compile, seed=0,
    )  # fmt: skip
    return env, actor, update


def sac(device: str, compile: str = "on", width: int = 256) -> tuple[Any, Any, Any]:
    """Environment, actor and update; the replay lies on the device."""
    torch.manual_seed(0)
    env = envs.make(ENV_ID, num_envs=NUM_ENVS, seed=1)
    actor = modules.tanh_normal_actor(env, (width, width)).to(device)
    loss = losses.SACLoss(actor, modules.q_value(env, 2, (width, width)).to(device))
    buffer = data.ReplayBuffer(env, 100_000, device=device, seed=0)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    update = updates.OffPolicyUpdate(loss, buffer, optimizer, batch_size=256, learning_starts=512, compile=compile)
    return env, actor, update


def rollout(device: str, rows: int = NUM_ENVS * STEPS) -> TensorDict:
    """A made-up rollout ``[8, T]``, the same on every device."""
    draw, shape = torch.Generator().manual_seed(1), (NUM_ENVS, rows // NUM_ENVS)
    obs = torch.randn(NUM_ENVS, shape[1] + 1, 3, generator=draw)
    flag = torch.zeros(*shape, 1, dtype=torch.bool)
    after = {"observation": obs[:, 1:], "reward": torch.randn(*shape, 1, generator=draw)}
    after |= {"done": flag, "terminated": flag.clone(), "truncated": flag.clone()}
    now = {"observation": obs[:, :-1], "action": torch.rand(*shape, 1, generator=draw) * 2 - 1}
    now["action_log_prob"] = torch.randn(shape, generator=draw) - 1
    return TensorDict({**now, "next": after}, shape).to(device)


def wait(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def milliseconds(call: Callable[[], Any], calls: int, device: str) -> float:
    """Of one call, after some of warm-up."""
    for _ in range(10):
        call()
    wait(device)
    start = time.perf_counter()
    for _ in range(calls):
        call()
    wait(device)
    return (time.perf_counter() - start) / calls * 1e3


def bound(update: Any, device: str, rows: int) -> tuple[Callable[[], Any], Any]:
    """A call of the update's step on the rollout or the replay, and the native code under it."""
    if isinstance(update, updates.OffPolicyUpdate):
        update.buffer.extend(rollout(device))
        update.train(1)
        plan: Any = update._plan
        step, index = plan.every, update.buffer.sample_index(256)[0]
        return partial(step.bind(update.buffer.data, index), index), step.native[0]
    whole = rollout(device, max(rows * 2, NUM_ENVS * STEPS))
    update.epochs = 1
    update(whole)
    flat = update._rows(update._plan, whole)
    index = torch.arange(rows, device=device)
    return partial(update._plan.step.bind(flat, index), index), update._plan.step.native[0]


def not_captured(graph: Any, leaves_of: Any, held: Any, inputs: Any) -> Any:
    return lambda data: partial(graph, *leaves_of(data))


def step_times(options: Options) -> list[tuple[str, str]]:
    """Of every way to run a step; the rung that was reached stands beside each."""
    makers = {
        "PPO, 64 rows, 64 x 64": (partial(ppo, options.device), 64),
        f"PPO, {options.rows:,} rows, 256 x 256": (
            partial(ppo, options.device, minibatch=options.rows, width=256), options.rows,
        ),
        "SAC, 256 rows, 256 x 256": (partial(sac, options.device), 256),
    }  # fmt: skip
    rows = []
    for name, (make, size) in makers.items():
        for how in ("eager", "compiled", "captured"):
            captured = recorded.captured
            if how == "compiled":
                recorded.captured = not_captured
            try:
                call, native = bound(make(compile="off" if how == "eager" else "auto")[2], options.device, size)
                ms = milliseconds(call, options.calls // (4 if how == "eager" else 1), options.device)
                rows.append((f"step, {name}, {how}", f"{ms:.3f} ms ({native.rung})"))
            except Exception as error:  # the table says which way fails, and goes on
                rows.append((f"step, {name}, {how}", f"failed: {str(error).splitlines()[0][:120]}"))
            finally:
                recorded.captured = captured
    return rows


def equality(options: Options) -> list[tuple[str, str]]:
    """Weights after an update of PPO, in float64, on the CPU as it is and on the device as it is fastest."""
    torch.set_default_dtype(torch.float64)
    try:
        weights = []
        for device, compile in (("cpu", "off"), (options.device, "auto")):
            update = ppo(device, compile=compile)[2]
            for _ in range(2):
                update(rollout(device).apply(lambda x: x.double() if x.is_floating_point() else x))
            weights.append(torch.cat([p.detach().cpu().flatten() for p in update.loss.parameters()]))
    finally:
        torch.set_default_dtype(torch.float32)
    difference = (weights[0] - weights[1]).abs().max() / weights[0].abs().max()
    return [("PPO, 256 steps in float64, device beside CPU, relative difference", f"{float(difference):.1e}")]


def end_to_end(options: Options) -> list[tuple[str, str]]:
    """Frames a second with the environments on the CPU, after the first rollouts and compilation."""
    rows = []
    for name, make, frames in (("PPO", ppo, options.frames), ("SAC", sac, options.frames // 8)):
        for device in dict.fromkeys(("cpu", options.device)):
            env, actor, update = make(device, compile="auto")
            batch = NUM_ENVS * (STEPS if name == "PPO" else 16)
            collector = collectors.VectorCollector(env, actor, frames_per_batch=batch)
            warm = 2 if name == "PPO" else 8
            for data_ in islice(collector, warm):
                update(data_)
            wait(device)
            start, before = time.perf_counter(), collector.frames
            for data_ in islice(collector, max(frames // batch, 1)):
                update(data_)
            wait(device)
            rate = (collector.frames - before) / (time.perf_counter() - start)
            collector.shutdown()
            rows.append((f"{name}, end to end, {device}", f"{rate:,.0f} frames/s"))
    return rows


def memory(options: Options) -> list[tuple[str, str]]:
    if options.device == "cpu":
        return [("memory", "not measured on a CPU")]
    return [("most memory allocated on the device", f"{torch.cuda.max_memory_allocated() / 2**20:,.0f} MiB")]


if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    logging.getLogger("pgkit").setLevel(logging.ERROR)  # made-up rollouts are of no policy
    name = torch.cuda.get_device_name() if options.device != "cpu" else "the CPU, a rehearsal"
    print(f"torch {torch.__version__}, {name}\n\n| what | figure |\n|---|---|", flush=True)
    for part in (step_times, equality, end_to_end, memory):
        try:
            found = part(options)
        except Exception as error:
            found = [(part.__name__, f"failed: {str(error).splitlines()[0][:160]}")]
        for what, figure in found:
            print(f"| {what} | {figure} |", flush=True)
