"""Tokens on one thread: sampling with and without the key-value cache, a step eager and compiled, its products.

python tests/benchmarks/tokens_speed.py
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median

import torch
from tensordict import TensorDict

from pgkit import envs, losses, modules, updates
from pgkit.modules.tokens import TokenActor, draw


def seconds(run: Callable[[], object], repeats: int) -> float:
    """Median time of a call, after one that is not counted."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return median(times)


@torch.no_grad()
def without_cache(actor: TokenActor, observation: torch.Tensor, length: int, copies: int) -> torch.Tensor:
    """The same completions, every prefix read again for every token."""
    tokens = observation.repeat_interleave(copies, 0)
    mask = torch.ones_like(tokens, dtype=torch.bool)
    for _ in range(length):
        token = draw(actor.network(tokens, mask)[:, -1].log_softmax(-1)).unsqueeze(1)
        tokens, mask = torch.cat([tokens, token], 1), torch.cat([mask, torch.ones_like(token, dtype=torch.bool)], 1)
    return tokens


def sampling(prompt: int, length: int, repeats: int) -> None:
    env = envs.prompts(["x" * prompt], 16, reward=lambda p, c: 0.0, prompt_length=prompt, completion_length=length)
    actor = modules.causal_lm(env)
    actor.stop = -1  # completions of full length, as below
    observation = env.reset()["observation"]
    cached = seconds(lambda: actor.sample(observation, length, 16), repeats)
    plain = seconds(lambda: without_cache(actor, observation, length, 16), repeats)
    rate, gain = 256 * length / cached, plain / cached
    print(
        f"sampling 256 x {length} after {prompt}: {cached * 1e3:.1f} ms, {rate:,.0f} tokens/s, {gain:.1f} times without"
    )


def products(actor: TokenActor, tokens: int) -> Callable[[], None]:
    """The matrix products of a step, forward and backward, alone."""
    weights = [p for p in actor.network.parameters() if p.dim() == 2]
    pairs = [(torch.randn(tokens, w.shape[1]), w.detach(), torch.randn(tokens, w.shape[0])) for w in weights]

    def run() -> None:
        for x, w, g in pairs:
            _ = x @ w.T, g @ w, g.T @ x

    return run


def step(repeats: int) -> None:
    env = envs.prompts(lambda r: "x" * 16, 8, reward=len, prompt_length=16, completion_length=16)
    actor = modules.causal_lm(env, layers=4, width=192, heads=6)
    data = env.rows(["x" * 16] * 128, ["y" * 15] * 128)
    data["advantage"] = torch.randn(128, 32, 1)
    data["log_probs", "full"] = actor(data.copy())["log_probs", "full"].detach()
    millions, alone = sum(p.numel() for p in actor.parameters()) / 1e6, seconds(products(actor, 128 * 31), repeats)
    print(f"{millions:.1f}M parameters, 128 rows of 32 tokens; products alone {alone * 1e3:.0f} ms")
    for mode in ("off", "on"):
        update = updates.OnPolicyUpdate(
            losses.GRPOLoss(actor), None, torch.optim.Adam(actor.parameters(), lr=1e-6),
            epochs=1, minibatch_size=128, compile=mode,
        )  # fmt: skip
        rows = TensorDict(data.to_dict(), [128])
        print(f"step, compile {mode}: {seconds(lambda u=update, r=rows: u(r), repeats) * 1e3:.0f} ms")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    torch.set_num_threads(1)
    torch.manual_seed(0)
    sampling(16, 16, repeats)
    sampling(8, 5, repeats)
    step(repeats)
