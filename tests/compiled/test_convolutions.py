"""Convolutions in bfloat16: the same numbers to 8 bits, biases in float32, only where asked for and faster."""

import pytest
import torch
from torch.nn import functional as F

from pgkit.compiled import convolutions, products, set_matmul
from pgkit.compiled.native import compile_record, record


@pytest.fixture(autouse=True)
def fresh(tmp_path, monkeypatch):
    """No choices yet, and a file of its own; bfloat16 wins every measurement."""
    monkeypatch.setattr(products, "_choices", {})
    monkeypatch.setattr(products, "_file", lambda: tmp_path / "products.json")
    monkeypatch.setattr(convolutions, "fastest", lambda kernels: "bf16")
    set_matmul("bf16")
    yield
    set_matmul("auto")


def draw(*shape, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=dtype)


def images(dtype=torch.float32):
    """Images, and weights and biases of two layers."""
    return [draw(*shape, dtype=dtype) for shape in ((5, 3, 12, 12), (8, 3, 4, 4), (8,), (6, 8, 3, 3))]


def forward_and_backward(x, one, bias, two):
    """Two layers, one reads what the other writes; the gradients of the weights, which pass through both."""
    params = [p.detach().requires_grad_() for p in (one, bias, two)]
    with torch.enable_grad():
        hidden = F.conv2d(x, params[0], params[1], stride=2)
        out = F.conv2d(hidden, params[2], padding=1)
        return [out.detach(), *torch.autograd.grad(out.square().sum(), params)]


def halves(graph):
    return sum(node.kwargs.get("dtype") is torch.bfloat16 for node in graph.graph.nodes)


def test_values_and_gradients_are_those_of_float32_to_eight_bits():
    graph = record(forward_and_backward, images())
    convolutions.halve_convolutions(graph)
    assert halves(graph) == 2 + 2 + 3 + 3
    for got, its in zip(graph(*images()), forward_and_backward(*images()), strict=True):
        assert got.dtype is torch.float32
        assert 0 < (got - its).abs().max() <= 2e-2 * its.abs().max()


def test_a_bias_and_its_gradient_are_added_up_in_float32():
    def function(x, weight, bias):
        bias = bias.detach().requires_grad_()
        with torch.enable_grad():
            out = F.conv2d(x, weight, bias)
            return [out.detach(), *torch.autograd.grad((out * torch.arange(9.0)).sum(), bias)]

    given = [torch.zeros(2, 3, 9, 9), draw(4, 3, 1, 1), draw(4) * 1.001]
    graph = record(function, given)
    convolutions.halve_convolutions(graph)
    out, grad = graph(*given)
    assert halves(graph) >= 2 and torch.equal(out, given[2].view(1, 4, 1, 1).expand_as(out))  # bfloat16 would round it
    assert grad.tolist() == [2 * 9 * 36.0] * 4  # 2 images, 9 rows of 0 + 1 + ... + 8


@pytest.mark.parametrize("case", ["float32", "auto", "float64", "slower"])
def test_otherwise_nothing_changes(case, monkeypatch):
    if case in ("float32", "auto"):
        set_matmul(case)
    if case == "slower":
        monkeypatch.setattr(convolutions, "fastest", lambda kernels: "torch")
    given = images(torch.float64 if case == "float64" else torch.float32)
    graph = record(forward_and_backward, given)
    before = [node.target for node in graph.graph.nodes]
    convolutions.halve_convolutions(graph)
    assert [node.target for node in graph.graph.nodes] == before


def test_a_real_measurement_is_made_once_and_kept(monkeypatch):
    monkeypatch.setattr(convolutions, "fastest", products.fastest)
    for _ in range(2):
        convolutions.halve_convolutions(record(forward_and_backward, images()))
        assert len(products._choices) == 4 and set(products._choices.values()) <= {"torch", "bf16"}
        monkeypatch.setattr(convolutions, "fastest", lambda kernels: pytest.fail("measured again"))


def test_native_code_makes_them_so():
    graph = record(forward_and_backward, images())
    native = compile_record(graph, images())
    for got, its in zip(native(images()), forward_and_backward(*images()), strict=True):
        assert 0 < (got - its).abs().max() <= 2e-2 * its.abs().max()
