"""The matmuls of an update with nothing around them: what an implementation that uses these kernels cannot get below.

    python tests/benchmarks/floors.py

prints MKL's floor and oneDNN's for SAC's update, in float32 and bfloat16, with the CPU and its instructions.

A matmul is ``(left, right, out)``, batched over ``num`` networks of these layer sizes, in the layout of autograd's.
"""

from itertools import pairwise

import contest
import torch
from torch import Tensor

from pgkit.compiled.products import cpu

Matmuls = list[tuple[Tensor, Tensor, Tensor]]
BATCH = 256


def forward(num: int, sizes: list[int]) -> Matmuls:
    """One forward pass."""
    layers = pairwise(sizes)
    return [(torch.randn(num, BATCH, i), torch.randn(num, i, o), torch.empty(num, BATCH, o)) for i, o in layers]


def weight_gradients(num: int, sizes: list[int]) -> Matmuls:
    """The weights' part of a backward pass."""
    layers = pairwise(sizes)
    return [(torch.randn(num, BATCH, i).mT, torch.randn(num, BATCH, o), torch.empty(num, i, o)) for i, o in layers]


def input_gradients(num: int, sizes: list[int], first: int) -> Matmuls:
    """The inputs' part of a backward pass, down to the input of layer ``first``."""
    layers = list(pairwise(sizes))[first:]
    return [(torch.randn(num, BATCH, o), torch.randn(num, i, o).mT, torch.empty(num, BATCH, i)) for i, o in layers]


def actor_critic(
    actor: list[int], critic: list[int], targets: int, learning: int, climbed: int
) -> tuple[Matmuls, Matmuls]:
    """The matmuls of an off-policy update: the critics' part, and the actor's.

    Critics: actor and ``targets`` critics forward for the target; ``learning`` critics forward, weight gradients of
    every layer, input gradients of all but the first. Actor: it and ``climbed`` critics forward; input gradients
    through these down to the action; the actor's weight gradients, input gradients of all but its first layer.
    """
    target = forward(1, actor) + forward(targets, critic)
    back = weight_gradients(learning, critic) + input_gradients(learning, critic, first=1)
    through = forward(climbed, critic) + input_gradients(climbed, critic, first=0)
    policy = forward(1, actor) + through + weight_gradients(1, actor) + input_gradients(1, actor, first=1)
    return target + forward(learning, critic) + back, policy


def run(matmuls: Matmuls) -> None:
    """Each once, by torch's own kernel: MKL's, in float32 on x86."""
    for left, right, out in matmuls:
        torch.bmm(left, right, out=out)


def run_onednn(matmuls: Matmuls) -> None:
    """Each once, by oneDNN, one network at a time."""
    linear = torch.ops.mkldnn._linear_pointwise
    for left, right, _ in matmuls:
        for x, y in zip(left, right, strict=True):
            linear(x, y.t(), None, "none", [], "")


def gflop(matmuls: Matmuls) -> float:
    """Their floating-point operations, in billions."""
    return sum(2 * left.numel() * right.shape[-1] for left, right, _ in matmuls) / 1e9


def main() -> None:
    """SAC's update on HalfCheetah: 17 observations, 6 actions, two layers of 256."""
    learning, policy = actor_critic([17, 256, 256, 12], [23, 256, 256, 1], targets=2, learning=2, climbed=2)
    matmuls = learning + policy
    halves = [(left.bfloat16(), right.bfloat16(), out.bfloat16()) for left, right, out in matmuls]
    print(f"{cpu()}; {gflop(matmuls):.3f} GFLOP")
    for threads in sorted({1, torch.get_num_threads()}):
        torch.set_num_threads(threads)
        ways = {"MKL float32": (run, matmuls), "oneDNN float32": (run_onednn, matmuls), "bfloat16": (run, halves)}
        for name, (kernel, factors) in ways.items():
            took = contest.milliseconds(lambda kernel=kernel, factors=factors: kernel(factors), calls=100, warmup=10)
            print(f"{threads} thread(s) {name}: {took:.2f} ms, {gflop(matmuls) / took * 1e3:.0f} GFLOP/s")


if __name__ == "__main__":
    main()
