"""Which kernel makes each large matrix product of a recorded graph on this CPU: measured once, then kept.

A run repeats itself to the bit if the choices are the same again: they lie in a file by CPU and threads and in the
state of an update, and go to the worker processes.
"""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from hashlib import sha256
from logging import getLogger
from pathlib import Path
from typing import Any, Literal, cast, get_args

import torch
from torch import Tensor
from torch.fx import GraphModule, Node, Proxy
from torch.fx.proxy import GraphAppendingTracer

from pgkit.errors import UserError

Matmul = Literal["auto", "float32", "bf16"]
_LARGE = 2**18  # multiplications; torch's kernel starts soonest, and up to here that is what counts
_MARGIN = 0.9  # of torch's time: 5% in a measurement was nothing in a step
_SECONDS, _ROUNDS = 0.05, 20  # a measurement ends with either, after three rounds
_aten = torch.ops.aten
_setting: Matmul = "auto"
_choices: dict[str, str] = {}  # by product, with the setting and the threads


def set_matmul(matmul: str) -> None:
    """How this process makes the large float32 products of what it compiles on a CPU from now on, like torch's threads.

    Args:
        matmul: ``auto``: each by the fastest float32 kernel here, torch's own or oneDNN's. ``float32``: torch's own.
            ``bf16``: also in bfloat16, where that is faster; parameters, optimizer state and all else stay float32.

    Raises:
        UserError: it is none of these.
    """
    global _setting
    if matmul not in get_args(Matmul):
        raise UserError(f"matmul is 'auto', 'float32' or 'bf16', not {matmul!r}")
    _setting = cast(Matmul, matmul)


def matmul_state() -> dict[str, Any]:
    """The setting, and the choices so far, for :func:`load_matmul_state`."""
    return {"matmul": _setting, "choices": dict(_choices)}


def load_matmul_state(state: Mapping[str, Any], setting: bool = True) -> None:
    """Chooses as another process did, with its ``setting`` too or for whatever is set here."""
    if setting:
        set_matmul(state["matmul"])
    _choices.update(state.get("choices", {}))  # an earlier pgkit saved none


def in_bfloat16() -> bool:
    """Whether the setting allows bfloat16."""
    return _setting == "bf16"


def tolerances() -> dict[str, float]:
    """How far what is compiled may lie from the function: bfloat16 has 8 bits, float32 has 24."""
    return {"rtol": 5e-2, "atol": 1e-2} if _setting == "bf16" else {"rtol": 1e-3, "atol": 1e-4}


def fastest_products(graph: GraphModule) -> None:
    """Rewrites each large float32 product of a graph on the CPU for the kernel that is fastest here."""
    taken, tracer = Counter[str](), GraphAppendingTracer(graph.graph)
    for node in list(graph.graph.nodes):
        factors = _factors(node)
        if factors is None or _setting == "float32":
            continue
        name = _choice(*(x.meta["val"] for x in factors))
        taken[name] += 1
        if name == "torch":
            continue
        with graph.graph.inserting_before(node):
            *bias, x, y = (Proxy(given, tracer) for given in node.args)  # pyright: ignore[reportArgumentType]
            made = _kernels()[name](x, y, factors[0].meta["val"].shape)
            made = _aten.add.Tensor(made, *bias) if bias else made
        node.replace_all_uses_with(made.node)
        graph.graph.erase_node(node)
    graph.recompile()
    if taken:
        words = ", ".join(f"{count} by {name}" for name, count in sorted(taken.items()))
        getLogger("pgkit").info("large matrix products (matmul %s): %s", _setting, words)


def _factors(node: Node) -> tuple[Node, Node] | None:
    """The two factors of a large product in float32 on the CPU, None for anything else."""
    if node.target not in (_aten.mm.default, _aten.bmm.default, _aten.addmm.default, _aten.baddbmm.default):
        return None
    x, y = node.args[-2:]
    if node.kwargs or not isinstance(x, Node) or not isinstance(y, Node):  # beta and alpha are keywords
        return None
    one, other = x.meta.get("val"), y.meta.get("val")
    if one is None or other is None or one.device.type != "cpu" or {one.dtype, other.dtype} != {torch.float32}:
        return None
    return (x, y) if one.numel() * other.shape[-1] > _LARGE else None


def _choice(x: Tensor, y: Tensor) -> str:
    """The kernel of a product, measured where nobody has chosen yet."""
    product = " @ ".join(map(layout, (x, y)))
    name = chosen(product, lambda: _measured(x, y))
    if name not in _kernels():
        getLogger("pgkit").warning("%s was made by %s, which is not here: torch's own now", product, name)
    return name if name in _kernels() else "torch"


def layout(x: Tensor) -> str:
    """Shape and strides in words."""
    return f"{tuple(x.shape)} strides {tuple(x.stride())}"


def chosen(what: str, measure: Callable[[], str]) -> str:
    """The name chosen for this, with this setting and as many threads: here, in the file, or by measuring."""
    key = f"{_setting}, {torch.get_num_threads()} threads: {what}"
    if key not in _choices:
        file = _file()
        _choices.update({key: name for key, name in _read(file).items() if key not in _choices})
        if key not in _choices:
            _choices[key] = measure()
            _write(file, key)
    return _choices[key]


def _kernels() -> dict[str, Callable[[Any, Any, torch.Size], Any]]:
    """``(x, y, shape of x) -> x @ y``, by name."""
    kernels: dict[str, Callable[..., Any]] = {"torch": _torch}
    with suppress(AttributeError, RuntimeError):  # a torch without oneDNN, or whose operator has another name
        kernels["onednn"] = partial(_onednn, torch.ops.mkldnn._linear_pointwise.default)
    if _setting == "bf16":
        kernels["bf16"] = _bf16
    return kernels


def _torch(x: Any, y: Any, shape: torch.Size) -> Any:
    return _aten.bmm.default(x, y) if len(shape) == 3 else _aten.mm.default(x, y)


def _onednn(linear: Any, x: Any, y: Any, shape: torch.Size) -> Any:
    if len(shape) == 2:
        return linear(x, _aten.permute.default(y, [1, 0]), None, "none", [], "")
    pairs = [(_aten.select.int(x, 0, i), _aten.select.int(y, 0, i)) for i in range(shape[0])]
    return _aten.stack.default([_onednn(linear, one, other, shape[1:]) for one, other in pairs])


def _bf16(x: Any, y: Any, shape: torch.Size) -> Any:
    x, y = (_aten._to_copy.default(z, dtype=torch.bfloat16) for z in (x, y))
    return _aten._to_copy.default(_torch(x, y, shape), dtype=torch.float32)


def _measured(x: Tensor, y: Tensor) -> str:
    """The fastest kernel for numbers laid out like these."""
    x, y = like(x), like(y)
    return fastest({name: partial(kernel, x, y, x.shape) for name, kernel in _kernels().items()})


def fastest(kernels: Mapping[str, Callable[[], Any]]) -> str:
    """The name of the fastest, torch's own if none is clearly faster: the best time of each counts, in alternation."""
    best, start, rounds = dict.fromkeys(kernels, math.inf), time.perf_counter(), 0
    while rounds < 3 or (rounds < _ROUNDS and time.perf_counter() - start < _SECONDS):
        for name, kernel in kernels.items():
            begin = time.perf_counter()
            kernel()
            best[name] = min(best[name], time.perf_counter() - begin)
        rounds += 1
    first = min(best, key=lambda name: best[name])
    return first if best[first] < _MARGIN * best["torch"] else "torch"


def like(x: Tensor) -> Tensor:
    """Random numbers in the layout of a tensor of the recording, which has none."""
    size = 1 + sum((size - 1) * stride for size, stride in zip(x.shape, x.stride(), strict=True))
    return torch.randn(size, generator=torch.Generator(), dtype=x.dtype).as_strided(tuple(x.shape), tuple(x.stride()))


@contextmanager
def as_they_are() -> Iterator[None]:
    """While it compiles, inductor calls oneDNN's operator as it is; its own lowering would copy the factors first."""
    from torch._inductor.lowering import lowerings, make_fallback

    try:
        linear = torch.ops.mkldnn._linear_pointwise.default
    except (AttributeError, RuntimeError):  # a torch without oneDNN, or whose operator has another name
        yield
        return
    before = lowerings.pop(linear, None)
    make_fallback(linear, warn=False, override_decomp=True)
    try:
        yield
    finally:
        lowerings.pop(linear, None)
        if before is not None:
            lowerings[linear] = before


def cpu() -> str:
    """Model of the CPU and the instructions that torch and oneDNN may use."""
    names = [platform.processor() or platform.machine()]
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith(("model", "cpu family"))][:3]
    bound = os.environ.get("ONEDNN_MAX_CPU_ISA")
    return ", ".join([*names, torch.backends.cpu.get_cpu_capability(), *([f"oneDNN at most {bound}"] if bound else [])])


def _file() -> Path:
    """The choices on this CPU with this torch, beside inductor's own cache."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    name = sha256(f"{cpu()}, torch {torch.__version__}".encode()).hexdigest()[:16]
    return Path(cache_dir()) / f"pgkit_products_{name}.json"


def _read(file: Path) -> dict[str, str]:
    try:
        found = json.loads(file.read_text())
        return {str(key): str(name) for key, name in found.items()}
    except (OSError, ValueError, AttributeError):
        return {}


def _write(file: Path, product: str) -> None:
    """Adds a choice; another process may have been first, and then its choice holds here as well."""
    found = _read(file)
    _choices[product] = found.setdefault(product, _choices[product])
    with suppress(OSError):  # a cache that cannot be written is measured again
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(f".{os.getpid()}")
        part.write_text(json.dumps(found, indent=0))
        os.replace(part, file)
