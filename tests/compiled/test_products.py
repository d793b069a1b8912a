"""Large products by the kernel that is fastest here: the same numbers, the same choice again, nothing else touched."""

import json
import logging

import pytest
import torch

from pgkit.compiled import load_matmul_state, matmul_state, products, set_matmul
from pgkit.compiled.native import compile_record, record
from pgkit.errors import UserError
from pgkit.updates import state as states

M, K, N, E = 96, 160, 72, 2  # every product of these is large


@pytest.fixture(autouse=True)
def fresh(tmp_path, monkeypatch):
    """No choices yet, and a file of its own."""
    monkeypatch.setattr(products, "_choices", {})
    monkeypatch.setattr(products, "_file", lambda: tmp_path / "cache" / "products.json")
    yield
    set_matmul("auto")


@pytest.fixture
def fastest(monkeypatch):
    """``fastest(name)`` makes a kernel win every measurement, and counts them."""
    seen = []

    def win(name):
        monkeypatch.setattr(products, "_measured", lambda x, y: seen.append((x.shape, y.shape)) or name)
        return seen

    return win


def draw(*shape, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=dtype)


WIDE, SPARSE = draw(M, N), draw(M, 128)


def every_layout(x, y, bias, xs, ys, biases):
    """Plain, with bias, transposed left and right, of networks, of a view."""
    right, left = y.t().contiguous().t(), x.t().contiguous().t()
    return [
        x.mm(y),
        torch.addmm(bias, x, y),
        left.mm(right),
        x.t().mm(WIDE),
        torch.addmm(bias, x, y, beta=2.0),
        x.t()[::2].mm(SPARSE),
        xs.bmm(ys),
        torch.baddbmm(biases, xs, ys),
        xs.mT.bmm(xs),
        xs.bmm(ys.mT.contiguous().mT),
        x.expand(E, M, K).bmm(ys),
    ]


def inputs(dtype=torch.float32):
    shapes = [(M, K), (K, N), (N,), (E, M, K), (E, K, N), (E, 1, N)]
    return [draw(*shape, dtype=dtype) for shape in shapes]


def targets(graph):
    return [str(node.target) for node in graph.graph.nodes]


@pytest.mark.parametrize(("name", "setting", "error"), [("onednn", "auto", 1e-5), ("bf16", "bf16", 1e-2)])
def test_another_kernel_gives_the_products(fastest, name, setting, error):
    fastest(name)
    set_matmul(setting)
    graph = record(every_layout, inputs())
    products.fastest_products(graph)
    marks = [t for t in targets(graph) if ("linear_pointwise" if name == "onednn" else "_to_copy") in t]
    assert len(marks) >= 14  # 6 of one network, 5 of two, less the one whose bias is weighed
    for got, its in zip(graph(*inputs()), every_layout(*inputs()), strict=True):
        assert (got - its).abs().max() <= error * its.abs().max()
        assert got.dtype is torch.float32


def test_native_code_takes_the_kernel_and_leaves_inductor_as_it_was(fastest):
    from torch._inductor.lowering import lowerings

    fastest("onednn")
    linear = torch.ops.mkldnn._linear_pointwise.default
    before = lowerings.get(linear)
    given = [draw(M, K), draw(E, M, K), draw(E, K, N)]

    def function(x, xs, ys):
        return [(x.t() @ x).relu(), torch.bmm(xs, ys).relu() + 1]

    graph = record(function, given)
    native = compile_record(graph, given)
    assert sum("linear_pointwise" in t for t in targets(graph)) == 3
    assert lowerings.get(linear) is before
    for seed in (1, 2):
        other = [x * seed for x in given]
        torch.testing.assert_close(native(list(other)), function(*other), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("case", ["small", "float64", "meta", "float32"])
def test_what_is_small_in_float64_or_elsewhere_stays(fastest, case):
    seen = fastest("onednn")
    x, y = {
        "small": (draw(64, 64), draw(64, 64)),
        "float64": (draw(M, K, dtype=torch.float64), draw(K, N, dtype=torch.float64)),
        "meta": (draw(M, K).to("meta"), draw(K, N).to("meta")),
        "float32": (draw(M, K), draw(K, N)),
    }[case]
    set_matmul("float32" if case == "float32" else "auto")
    graph = record(lambda x, y: [x.mm(y)], [x, y])
    products.fastest_products(graph)
    assert "aten.mm.default" in targets(graph) and not seen


def test_what_is_not_clearly_faster_is_not_taken(monkeypatch):
    def kernels(cost):
        times, now = {"torch": 100, "onednn": cost}, [0.0]

        def run(name):
            now[0] += times[name] * 1e-6

        monkeypatch.setattr(products.time, "perf_counter", lambda: now[0])
        return {name: lambda x, y, shape, name=name: run(name) for name in times}

    for cost, chosen in ((91, "torch"), (89, "onednn"), (300, "torch")):
        made = kernels(cost)
        monkeypatch.setattr(products, "_kernels", lambda made=made: made)
        assert products._measured(draw(M, K), draw(K, N)) == chosen


def test_a_real_measurement_chooses_one_that_is_here_and_draws_nothing():
    random = torch.get_rng_state()
    assert products._measured(draw(E, M, K), draw(E, K, N).mT.contiguous().mT) in products._kernels()
    assert torch.equal(torch.get_rng_state(), random)


def test_a_choice_is_measured_once_and_kept_by_setting_and_threads(fastest, tmp_path):
    seen = fastest("onednn")
    x, y = draw(M, K), draw(K, N)
    assert [products._choice(x, y) for _ in range(2)] == ["onednn"] * 2 and len(seen) == 1
    products._choices.clear()  # another process
    fastest("torch")
    assert products._choice(x, y) == "onednn" and len(seen) == 1
    file = tmp_path / "cache" / "products.json"
    (key,) = json.loads(file.read_text())
    assert key == f"auto, {torch.get_num_threads()} threads: (96, 160) strides (160, 1) @ (160, 72) strides (72, 1)"
    products._choices.clear()
    file.write_text("{")  # damaged: measured again
    assert products._choice(x, y) == "torch" and json.loads(file.read_text()) == {key: "torch"}
    set_matmul("bf16")
    products._choice(x, y)
    assert len(json.loads(file.read_text())) == 2


def test_the_first_of_two_processes_chooses(fastest):
    x, y = draw(M, K), draw(K, N)
    fastest("onednn")
    products._choice(x, y)
    (key,) = products._choices
    products._choices[key] = "torch"  # what this one measured meanwhile
    products._write(products._file(), key)
    assert products._choices[key] == "onednn"


def test_an_update_saves_its_choices_and_takes_them_again(fastest):
    x, y = draw(M, K), draw(K, N)
    fastest("onednn")
    products._choice(x, y)
    saved = states.save({"loss": None})
    products._choices.clear()
    set_matmul("float32")
    states.load({"loss": None}, saved)
    assert list(products._choices.values()) == ["onednn"] and matmul_state()["matmul"] == "float32"
    load_matmul_state(saved["products"])  # a worker takes the setting as well
    assert matmul_state() == saved["products"]


def test_a_kernel_that_is_not_here_is_torchs_and_says_so(monkeypatch, caplog):
    x, y = draw(M, K), draw(K, N)
    monkeypatch.setattr(products, "_measured", lambda x, y: "onednn")
    products._choice(x, y)
    monkeypatch.setattr(torch.ops.mkldnn, "_linear_pointwise", object())
    graph = record(lambda x, y: [x.mm(y)], [x, y])
    with caplog.at_level(logging.INFO, "pgkit"):
        products.fastest_products(graph)
    assert "was made by onednn, which is not here" in caplog.text and "1 by torch" in caplog.text
    assert "aten.mm.default" in targets(graph)


def test_another_setting_is_refused():
    with pytest.raises(UserError, match="'auto', 'float32' or 'bf16', not 'fp16'"):
        set_matmul("fp16")


def test_what_the_compiler_raises_is_what_is_told():
    with pytest.raises(RuntimeError, match="of the compiler"), products.as_they_are():
        raise RuntimeError("of the compiler")
