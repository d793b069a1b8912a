"""Frames per second of SAC on HalfCheetah-v5, one update a frame, beside the update's matmuls alone.

    python tests/benchmarks/sac_speed.py --json sac_speed.json

Same env, nets and update for everyone: one env, batch 256, 2x256 ReLU, twin critics, automatic temperature,
Adam 3e-4, tau 0.005, gamma 0.99, replay of a million, 1,000 random frames first.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

import contest
import floors
import torch
import tyro
from tensordict import TensorDict

ENV_ID, BATCH, WIDTH, OBSERVATION, ACTION = "HalfCheetah-v5", floors.BATCH, 256, 17, 6
RANDOM_FRAMES, CHUNK, BUFFER = 1000, 500, 1_000_000
STEPS = 16  # frames collected before as many updates, in recipes/sac.py


@dataclass
class Options(contest.Options):
    """Speed of SAC, several libraries in alternation."""

    frames: int = 5000
    warmup: int = RANDOM_FRAMES + 1000
    replay: bool = True
    """Also time the parts of replay and update; they compile two more graphs."""


def agent(seed: int, stored: int = 0, sampler: Any = None) -> tuple[Any, Any, Any]:
    """pgkit's environment, actor and update, with so many made-up frames in the replay buffer."""
    from pgkit import data, envs, losses, modules, updates

    torch.manual_seed(seed)
    env = envs.make(ENV_ID, seed=seed)
    actor, critics = modules.tanh_normal_actor(env, (WIDTH, WIDTH)), modules.q_value(env, 2, (WIDTH, WIDTH))
    loss = losses.SACLoss(actor, critics, gamma=0.99)
    buffer = data.ReplayBuffer(env, BUFFER, sampler=sampler)
    for _ in range(stored // CHUNK):
        buffer.extend(frames(CHUNK))
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    settings: Any = {"batch_size": BATCH, "learning_starts": RANDOM_FRAMES, "tau": 0.005, "compile": "on"}
    return env, actor, updates.OffPolicyUpdate(loss, buffer, optimizer, **settings)


def frames(steps: int) -> TensorDict:
    """One environment's made-up frames ``[1, steps]``, one episode."""
    obs, flag = torch.randn(1, steps + 1, OBSERVATION), torch.zeros(1, steps, 1, dtype=torch.bool)
    after = {"observation": obs[:, 1:], "reward": torch.randn(1, steps, 1), "done": flag, "terminated": flag}
    now = {"observation": obs[:, :-1], "action": torch.rand(1, steps, ACTION) * 2 - 1}
    return TensorDict({**now, "next": after}, [1, steps])


def pgkit(seed: int, steps: int = STEPS, stored: int = 0, matmul: str = "auto", overlap: bool = False) -> Iterator[int]:
    """pgkit through its public API, so many frames and as many updates in turn."""
    from pgkit import collectors
    from pgkit.compiled import set_matmul

    set_matmul(matmul)
    env, actor, update = agent(seed, stored)
    make_collector = collectors.AsyncCollector if overlap else collectors.VectorCollector
    collector: Any = make_collector(env, actor, frames_per_batch=steps, init_random_frames=RANDOM_FRAMES)
    for rollout in collector:
        update(rollout)
        yield collector.frames


def sb3(seed: int, steps: int = 1) -> Iterator[int]:
    """Stable-Baselines3."""
    from stable_baselines3 import SAC

    yield from _baselines(SAC, seed, steps)


def sbx(seed: int, steps: int = 1) -> Iterator[int]:
    """SBX: Stable-Baselines3's algorithms in JAX, compiled by XLA."""
    from sbx import SAC

    yield from _baselines(SAC, seed, steps)


def torchrl(seed: int, compiled: bool, steps: int = CHUNK) -> Iterator[int]:
    """An agent assembled from TorchRL's parts."""
    import torchrl_parts

    sizes = {"batch_size": BATCH, "random_frames": RANDOM_FRAMES, "chunk": steps, "buffer": BUFFER}
    yield from torchrl_parts.sac(seed, env_id=ENV_ID, compiled=compiled, **sizes)


def _baselines(algorithm: Any, seed: int, steps: int) -> Iterator[int]:
    from stable_baselines3.common.env_util import make_vec_env

    model = algorithm(
        "MlpPolicy",
        make_vec_env(ENV_ID, 1, seed=seed),
        batch_size=BATCH,
        buffer_size=BUFFER,
        learning_rate=3e-4,
        learning_starts=RANDOM_FRAMES,
        train_freq=steps,
        gradient_steps=steps,
        tau=0.005,
        gamma=0.99,
        ent_coef="auto",
        policy_kwargs={"net_arch": [WIDTH, WIDTH]},
        device="cpu",
        seed=seed,
    )
    while True:
        model.learn(CHUNK, log_interval=10**9, reset_num_timesteps=False)
        yield model.num_timesteps


def floor(threads: int) -> tuple[float, float]:
    """Milliseconds that the matmuls of one SAC update take by the faster of MKL and oneDNN, and their GFLOP."""
    torch.set_num_threads(threads)
    actor, critic = [OBSERVATION, WIDTH, WIDTH, 2 * ACTION], [OBSERVATION + ACTION, WIDTH, WIDTH, 1]
    learning, policy = floors.actor_critic(actor, critic, targets=2, learning=2, climbed=2)
    matmuls = learning + policy
    kernels = (partial(floors.run, matmuls), partial(floors.run_onednn, matmuls))
    return min(contest.milliseconds(kernel, calls=300, warmup=50) for kernel in kernels), floors.gflop(matmuls)


def replay(threads: int, prioritized: bool) -> dict[str, float]:
    """Milliseconds a frame of replay and update: the write, the draw, the step with its gather and without."""
    from pgkit import data, updates
    from pgkit.updates.step import grads_of, metrics_of

    torch.set_num_threads(threads)
    _, _, update = agent(0, 20_000, data.Prioritized() if prioritized else None)
    rollout, buffer = frames(STEPS), update.buffer
    update.train(1)
    step = update._plan.every
    index = buffer.sample_index(BATCH)[0]
    batch = update._batches.gather(buffer.data, index)
    loss, optimizer, names = update.loss, update.optimizer, step.names[:-2]
    params = [p for group in optimizer.param_groups for p in group["params"]]

    def gradients(data: Any, _: Any) -> Any:
        out = loss(data.copy())
        grads = grads_of(out, params)
        return metrics_of(out, names, grads[0]), grads

    watch = {"the loss": loss}
    bare = updates.GradientStep(gradients, optimizer, names, watch=watch, after=update._average, mode="on")
    rows = torch.arange(BATCH)
    whole, alone = step.bind(buffer.data, index), bare.bind(batch, rows)
    times: dict[str, list[float]] = {"write": [], "draw": [], "step": [], "step without gather": []}
    draws = 1 if prioritized else STEPS  # as the update draws them
    for _ in range(10):
        times["write"].append(contest.milliseconds(lambda: buffer.extend(rollout), calls=100) / STEPS)
        times["draw"].append(contest.milliseconds(lambda: buffer.sample_index(BATCH, draws), calls=100) / draws)
        times["step"].append(contest.milliseconds(lambda: whole(index), calls=100))
        times["step without gather"].append(contest.milliseconds(lambda: alone(rows), calls=100))
    result = {name: median(values) for name, values in times.items()}
    result["memory, MB"] = sum(x.numel() * x.element_size() for x in buffer.data.values(True, True)) / 1e6
    return result


CONTENDERS = {
    "pgkit": contest.Contender(pgkit, "pgkit", f"{STEPS} frames, {STEPS} updates, the recipe's default"),
    "pgkit-1": contest.Contender(partial(pgkit, steps=1), "pgkit", "one frame, one update"),
    "pgkit-1M": contest.Contender(partial(pgkit, stored=BUFFER), "pgkit", "as the first, a million frames stored"),
    "pgkit-overlap": contest.Contender(partial(pgkit, overlap=True), "pgkit", "as the first, with --overlap"),
    "pgkit-bf16": contest.Contender(partial(pgkit, matmul="bf16"), "pgkit", "as the first, with --matmul bf16"),
    "pgkit-float32": contest.Contender(partial(pgkit, matmul="float32"), "pgkit", "as the first, MKL's products alone"),
    "sb3": contest.Contender(sb3, "stable_baselines3", "one frame, one update"),
    f"sb3-{STEPS}": contest.Contender(
        partial(sb3, steps=STEPS), "stable_baselines3", f"{STEPS} frames, {STEPS} updates"
    ),
    "sbx": contest.Contender(sbx, "sbx", "one frame, one update, JAX"),
    f"sbx-{STEPS}": contest.Contender(partial(sbx, steps=STEPS), "sbx", f"{STEPS} frames, {STEPS} updates, JAX"),
    "torchrl": contest.Contender(
        partial(torchrl, compiled=False), "torchrl", f"{CHUNK} frames, {CHUNK} updates; eager"
    ),
    f"torchrl-{STEPS}": contest.Contender(
        partial(torchrl, compiled=False, steps=STEPS), "torchrl", f"{STEPS} frames, {STEPS} updates; eager"
    ),
    "torchrl-compiled": contest.Contender(
        partial(torchrl, compiled=True), "torchrl", f"{CHUNK} frames, {CHUNK} updates; torch.compile(update)"
    ),
}

if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    threads = options.threads or 2
    alone = {} if options.contender else {"before": floor(threads)[0]}
    result = contest.run("SAC, HalfCheetah-v5, one update a frame", options, CONTENDERS, "pgkit")
    alone["after"], gflop = floor(threads)
    times, most = " to ".join(f"{ms:.2f}" for ms in sorted(alone.values())), 1e3 / min(alone.values())
    print(f"\nfloor, {threads} thread(s): the matmuls of one update ({gflop:.2f} GFLOP) take {times} ms", end=" ")
    print(f"(before and after the rounds): at most {most:.0f} updates/s")
    kinds = ("uniform", "prioritized") if options.replay else ()
    replays = {name: replay(threads, name == "prioritized") for name in kinds}
    for name, ms in replays.items():
        total = ms["write"] + ms["draw"] + ms["step"]
        share = (total - ms["step without gather"]) / total
        print(f"replay, {name}: {share:.1%} of a frame;", ", ".join(f"{part} {x:.3f}" for part, x in ms.items()))
    contest.write(options.json, {**result, "floor_ms": alone, "gflop": gflop, "replay_ms": replays})
