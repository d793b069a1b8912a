"""What surrounds a CUDA graph, without CUDA: memory that stays, strides, the device; where it fails, the next rung."""

from contextlib import nullcontext

import pytest
import torch
from torch import nn

from pgkit.compiled import captured, compiled

LAYOUTS = {
    "dense": lambda: torch.randn(4, 3),
    "transposed": lambda: torch.randn(3, 4).t(),
    "with gaps": lambda: torch.randn(4, 5)[:, 1:4],
    "expanded": lambda: torch.randn(4, 1).expand(4, 3),
    "empty": lambda: torch.randn(0, 3),
    "scalar": lambda: torch.randn(()),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_memory_that_stays_has_the_strides_that_the_code_was_made_for(layout, monkeypatch):
    """Compiled code does not look at strides: rows of a rollout that are views of a longer one must stay such views."""

    def capture(run, leaves, held, given):
        assert [x.stride() for x in leaves] == [first.stride()]
        return lambda: run(*leaves)

    monkeypatch.setattr(captured, "_capture", capture)
    first = LAYOUTS[layout]()
    bind = captured.captured(lambda x: [2 * x], lambda x: [x], [], [])
    for x in (first, first, *(LAYOUTS[layout]() for _ in range(3)), first):
        assert torch.equal(bind(x)()[0], 2 * x)


def test_a_graph_is_captured_on_the_device_of_its_tensors(monkeypatch):
    """``cuda:1`` is not the current device, and another thread may use either."""
    entered, graph = [], type("Graph", (), {"replay": lambda self: None})
    stream = type("Stream", (), {"wait_stream": lambda self, other: None})
    monkeypatch.setattr(torch.cuda, "device", lambda device: entered.append(device) or nullcontext())
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, **kwargs: entered.append(kwargs) or nullcontext())
    for name, fake in {"Stream": stream, "current_stream": stream, "CUDAGraph": graph}.items():
        monkeypatch.setattr(torch.cuda, name, fake)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    count, index = torch.zeros(1), torch.tensor([1])
    bind = captured.captured(lambda x, i: [count.add_(1) * x[i]], lambda x: [x], [count], [index])
    call = bind(torch.ones(3))
    assert entered == [torch.device("cpu"), {"capture_error_mode": "thread_local"}]
    assert count == 1  # the fake runs once where CUDA would capture; the warm-up is undone
    assert call(index)[0] == 1


def test_what_cannot_be_captured_runs_on_the_next_rung(monkeypatch, caplog):
    def refuse(*_):
        raise RuntimeError("operation not permitted when stream is capturing")

    caplog.set_level("INFO", "pgkit")
    monkeypatch.setattr(captured, "_capture", refuse)
    monkeypatch.setattr(torch.Tensor, "is_cuda", property(lambda x: True), raising=False)
    net = nn.Linear(2, 1)
    made = compiled(
        lambda data, x: [net(x).detach()], {"the net": net}, lambda data, x: [(data, 2 * x)], "record", name="the test"
    )
    x = torch.ones(3, 2)
    assert torch.equal(made.bind(None, x)(x)[0], net(x)) and made.rung == "eager"
    assert "operation not permitted when stream is capturing" in caplog.text
