"""A recorded and compiled function repeats the function, whatever its inputs and results share."""

from uuid import uuid4

import pytest
import torch
from torch._dynamo.utils import counters

from pgkit.compiled.native import call_functions, compile_record, record

BIAS = torch.arange(4.0)
WEIGHT = torch.nn.Parameter(torch.linspace(-1, 1, 12).reshape(3, 4))


def products(x, y):
    """Of both kinds, with tensors that are no inputs."""
    return [torch.addmm(BIAS, x, WEIGHT), y.mm(WEIGHT).sin(), torch.addmm(BIAS, x, WEIGHT, beta=2.0)]


def changes_an_input(x, y):
    x.add_(y.mm(WEIGHT).mean())
    return [x.sum()]


def gives_its_inputs(x, y):
    """One as it is, a view of the other."""
    return [x, y.view(-1), x * 2]


@pytest.mark.parametrize("function", [products, changes_an_input, gives_its_inputs])
@pytest.mark.parametrize("second", [slice(3, 6), slice(0, 3), slice(1, 4)], ids=["apart", "twice", "overlapping"])
@torch.no_grad()
def test_compiled_code_repeats_the_function(function, second):
    def inputs(seed):
        x = torch.randn(6, 3, generator=torch.Generator().manual_seed(seed))
        return [x[:3], x[second]]

    compiled = compile_record(record(function, inputs(0)), inputs(0))
    for seed in (0, 1):
        ours, its = inputs(seed), inputs(seed)
        torch.testing.assert_close(list(compiled(list(ours))), function(*its))
        torch.testing.assert_close(ours, its)


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float32, 2**-24), (torch.float64, 2**-53)])
@torch.no_grad()
def test_the_compiled_tanh_is_within_eight_roundings_everywhere(dtype, rounding):
    """Near zero too, where a quotient of exponentials would lose all digits; and never beyond 1."""
    sizes = torch.logspace(-30, 2, 10_000, dtype=dtype)
    special = torch.tensor([0.0, torch.inf, -torch.inf, torch.nan], dtype=dtype)
    x = torch.cat([sizes, -sizes, special])
    (got,) = compile_record(record(lambda x: [x.tanh()], [x]), [x])([x])
    expected = x.double().tanh()
    ours = got.double()
    assert torch.isnan(ours[-1]) and ours[-4] == 0
    assert ((ours - expected).abs()[:-1] <= 8 * rounding * expected.abs()[:-1]).all() and ours[:-1].abs().max() <= 1


def test_a_record_leaves_out_what_nobody_uses_but_what_it_writes_or_draws():
    def function(x):
        x.sin().exp()
        x.view(-1).add_(1)
        noise = torch.rand(2)  # others draw what follows it
        (noise + 1).sum()
        return [x * 2]

    graph = record(function, [torch.zeros(2, 2)])
    called = [str(node.target) for node in graph.graph.nodes if node.op == "call_function"]
    assert [name.split(".")[1] for name in called] == ["view", "add_", "rand", "mul"]


def test_what_was_compiled_once_is_not_compiled_again(monkeypatch):
    """Nor by a later process; but on a CPU with other instructions it is."""

    def compiled():
        inputs = [torch.ones(3, 3)]
        code = compile_record(record(lambda x: [x.sin() + x.mm(WEIGHT[:, :3])], inputs), list(inputs))
        torch.testing.assert_close(code(list(inputs))[0], inputs[0].sin() + inputs[0].mm(WEIGHT[:, :3]))
        return counters["inductor"]["fxgraph_cache_hit"]

    compiled()
    hits = compiled()
    assert compiled() == hits + 1
    other = str(uuid4())
    monkeypatch.setattr("pgkit.compiled.native.cpu", lambda: other)
    assert compiled() == hits + 1 and compiled() == hits + 2


@torch.no_grad()
def test_functions_in_the_place_of_operations_change_no_bit():
    def function(x):
        y = torch.addmm(BIAS, x, WEIGHT).tanh().clamp(-0.5, 0.5)
        parts = torch.cat([y, y.rsqrt(), 1 / y, 2 - y, y**2], -1).unsqueeze(0).squeeze(0)
        return [torch.where(parts > 0, parts, -parts.abs()), x.t().sum(), torch.stack([x, x], 1)]

    x = torch.linspace(-2, 2, 6).reshape(2, 3)
    graph = call_functions(record(function, [x]))
    assert any(node.target is torch.tanh for node in graph.graph.nodes)
    for got, expected in zip(graph(x), function(x), strict=True):
        assert torch.equal(got.nan_to_num(7.5), expected.nan_to_num(7.5))
