"""What ten critics cost beside two: a REDQ update of each, in units of its own matmuls.

    python tests/benchmarks/ensemble_cost.py --json ensemble_cost.json

One update is critics, actor, temperature, Adam and target averaging; 17 observations, 6 actions, batch 256, 2x256 ReLU.
With N critics, M = 2 of them make the target. The floor is the batched matmuls of the same update with nothing around
them. Updates and floors alternate, round by round; the table has medians over the rounds.
"""

from dataclasses import dataclass
from statistics import median
from typing import Any

import contest
import floors
import torch
import tyro

from pgkit import data, envs, losses, modules, updates

ENV_ID, WIDTH, OBSERVATION, ACTION, SUBSET = "HalfCheetah-v5", 256, 17, 6, 2


@dataclass
class Options:
    """Numbers of critics to compare, and how long."""

    critics: tuple[int, int] = (2, 10)
    """The fewer and the more critics."""
    rounds: int = 7
    """Rounds of updates and floors in alternation."""
    calls: int = 100
    """Timed calls of each in a round."""
    threads: int = 2
    """torch's threads."""
    blocks: bool = False
    """Critics with dropout and layer norm in place of plain perceptrons; the floor stays that of the matmuls."""
    json: str | None = None
    """Write the figures to this file."""


def agent(critics: int, blocks: bool) -> updates.OffPolicyUpdate:
    """REDQ with a full replay of random transitions."""
    torch.manual_seed(0)
    env = envs.make(ENV_ID)
    actor = modules.tanh_normal_actor(env, (WIDTH, WIDTH))
    layers: dict[str, Any] = {"norm": modules.EnsembleLayerNorm, "dropout": 0.01} if blocks else {}
    loss = losses.REDQLoss(
        actor, modules.q_value(env, critics, (WIDTH, WIDTH), **layers), sub_sample_len=min(SUBSET, critics)
    )
    buffer = data.ReplayBuffer(env, 10_000)
    buffer.extend(env.rollout(1_000, break_when_any_done=False))
    return updates.OffPolicyUpdate(
        loss, buffer, torch.optim.Adam(loss.parameters(), lr=3e-4), batch_size=floors.BATCH, compile="on"
    )


def matmuls(critics: int) -> floors.Matmuls:
    """Every matmul of one update."""
    actor, critic = [OBSERVATION, WIDTH, WIDTH, 2 * ACTION], [OBSERVATION + ACTION, WIDTH, WIDTH, 1]
    learning, policy = floors.actor_critic(actor, critic, min(SUBSET, critics), critics, critics)
    return learning + policy


def main(options: Options) -> None:
    """Prints the table."""
    torch.set_num_threads(options.threads)
    agents = {n: agent(n, options.blocks) for n in options.critics}
    alone = {n: matmuls(n) for n in options.critics}
    times: dict[tuple[str, int], list[float]] = {}
    for _ in range(options.rounds):
        for n in options.critics:
            step = contest.milliseconds(lambda n=n: agents[n].train(1), options.calls, warmup=10)
            times.setdefault(("update", n), []).append(step)
            floor = contest.milliseconds(lambda n=n: floors.run(alone[n]), options.calls, warmup=10)
            times.setdefault(("floor", n), []).append(floor)
    ms = {key: median(values) for key, values in times.items()}

    print(f"{'critics':>8} {'update ms':>10} {'floor ms':>9} {'update/floor':>13} {'GFLOP':>7}")
    for n in options.critics:
        step, floor = ms["update", n], ms["floor", n]
        print(f"{n:>8} {step:>10.2f} {floor:>9.2f} {step / floor:>13.2f} {floors.gflop(alone[n]):>7.3f}")
    few, many = options.critics
    update, floor = (ms[kind, many] / ms[kind, few] for kind in ("update", "floor"))
    flops = floors.gflop(alone[many]) / floors.gflop(alone[few])
    print(f"{many} critics against {few}: update {update:.2f} times, floor {floor:.2f} times, flops {flops:.2f} times")
    print(f"update ratio over floor ratio {update / floor:.2f}, over flop ratio {update / flops:.2f}")
    result = {f"{kind}_{n}_ms": value for (kind, n), value in ms.items()}
    contest.write(options.json, {**result, "over_floor": update / floor, "over_flops": update / flops})


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
