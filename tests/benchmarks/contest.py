"""A speed contest: every contender trains in a fresh process, in alternation, and one table says who won.

A contender is a generator: `next()` trains a little further and returns the environment frames done so far.
The clock starts after `warmup` frames: imports, compilation and first calls are left out for everyone.
"""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from importlib.util import find_spec
from statistics import median
from typing import Annotated, Any

import tyro

PACKAGES = ("torch", "torchrl", "stable_baselines3", "sbx-rl", "gymnasium", "mujoco", "jax")


@dataclass
class Contender:
    """Who trains, and with what."""

    start: Callable[[int], Iterator[int]]
    """`start(seed)` yields the frames done so far, for ever."""
    needs: str
    """The module it imports."""
    note: str
    """One line for the table."""


@dataclass
class Options:
    """A contest's command line."""

    frames: int
    """Frames each contender trains while the clock runs."""
    warmup: int
    """Frames trained before the clock starts."""
    rounds: int = 3
    """Times every contender runs; they alternate."""
    contenders: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Run only these; give the flag once a name."""
    threads: int | None = None
    """Threads for every contender; left out, each one's faster of 1 and 2 is tried out first."""
    json: str | None = None
    """Write settings, versions and every round's figures to this file."""
    seed: int = 1
    """Seed of the first round; round k uses seed + k."""
    contender: str | None = None
    """Train this one here, in this process, and print its figures as JSON (the parent uses it)."""


def milliseconds(call: Callable[[], Any], calls: int, warmup: int = 5) -> float:
    """Median wall time of one `call()` in milliseconds, after `warmup` calls that do not count."""
    for _ in range(warmup):
        call()
    times = []
    for _ in range(calls):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * median(times)


def run(title: str, options: Options, contenders: dict[str, Contender], reference: str) -> dict[str, Any]:
    """Hold the contest and print its table; ratios are `reference`'s frames/s over each contender's."""
    if options.contender:
        _train(options, contenders[options.contender])
        sys.exit()
    names = options.contenders or tuple(contenders)
    _refuse(names, contenders)
    threads = {name: options.threads or _faster(name, options) for name in names}
    rounds: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for index in range(options.rounds):
        for name in names:
            result = _spawn(name, threads[name], options.seed + index, options.frames, options.warmup)
            rounds[name].append(result)
            _say(f"round {index + 1}  {name:<18} {result['fps']:8.0f} frames/s")
    result = {"title": title, "options": asdict(options), "machine": machine(), "rounds": rounds}
    print(f"\n{title}\n{machine()['text']}; {options.frames:,} frames after {options.warmup:,} of warm-up\n")
    print(table(rounds, contenders, reference))
    return result


def write(path: str | None, result: dict[str, Any]) -> None:
    """Write `result` as JSON to `path`; nothing when `path` is None."""
    if path:
        with open(path, "w") as file:
            json.dump(result, file, indent=2)
            file.write("\n")


def table(rounds: dict[str, list[dict[str, Any]]], contenders: dict[str, Contender], reference: str) -> str:
    """The figures as a Markdown table: median, range, and the reference's median over each row's."""
    middle = {name: median(row["fps"] for row in rows) for name, rows in rounds.items()}
    lines = [
        "| contender | threads | frames/s, median | min to max | " + f"{reference} / it | how |",
        "|---|---|---|---|---|---|",
    ]
    for name, rows in rounds.items():
        low, high = min(row["fps"] for row in rows), max(row["fps"] for row in rows)
        ratio = f"{middle[reference] / middle[name]:.2f}" if reference in middle else ""
        cells = (
            name,
            rows[0]["threads"],
            f"{middle[name]:,.0f}",
            f"{low:,.0f} to {high:,.0f}",
            ratio,
            contenders[name].note,
        )
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines)


def machine() -> dict[str, Any]:
    """The processor with its instruction set, core count, Python and package versions."""
    from pgkit.compiled.products import cpu

    versions = {name: metadata.version(name) for name in PACKAGES if _installed(name)}
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    text = f"{cores} cores, {cpu()}, Python {platform.python_version()}"
    return {
        "text": ", ".join([text, *(f"{name} {version}" for name, version in versions.items())]),
        "versions": versions,
    }


def _installed(distribution: str) -> bool:
    try:
        metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return False
    return True


def _refuse(names: Sequence[str], contenders: dict[str, Contender]) -> None:
    unknown = [name for name in names if name not in contenders]
    if unknown:
        sys.exit(f"error: no contender {unknown[0]!r}; there are: {', '.join(contenders)}")
    missing = sorted({contenders[name].needs for name in names if find_spec(contenders[name].needs) is None})
    if missing:
        sys.exit(f"error: {', '.join(missing)} not installed; run: pip install 'pgkit-rl[bench]'")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _faster(name: str, options: Options) -> int:
    """1 or 2 threads, whichever is faster over a fifth of the frames."""
    speed = {}
    for threads in (1, 2):
        speed[threads] = _spawn(name, threads, options.seed, options.frames // 5, options.warmup)["fps"]
        _say(f"trial    {name:<18} {speed[threads]:8.0f} frames/s with {threads} thread{'s' * (threads > 1)}")
    return max(speed, key=lambda threads: speed[threads])


def _spawn(name: str, threads: int, seed: int, frames: int, warmup: int) -> dict[str, Any]:
    """Run one contender in a fresh process that sees `threads` threads, and read its figures back."""
    environment = dict(os.environ, OMP_NUM_THREADS=str(threads), MKL_NUM_THREADS=str(threads))
    if threads == 1:
        environment["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    flags = {"contender": name, "threads": threads, "seed": seed, "frames": frames, "warmup": warmup}
    command = [
        sys.executable,
        sys.argv[0],
        *(part for key, value in flags.items() for part in (f"--{key}", str(value))),
    ]
    child = subprocess.run(command, env=environment, capture_output=True, text=True)
    if child.returncode:
        sys.exit(f"{child.stderr}\nerror: contender {name} failed (exit code {child.returncode}); see above")
    return json.loads(child.stdout.splitlines()[-1])


def _train(options: Options, contender: Contender) -> None:
    """Train in this process: `warmup` frames off the clock, then at least `frames` on it."""
    born = time.perf_counter()
    progress = contender.start(options.seed)
    first = next(frames for frames in progress if frames >= options.warmup)
    start = time.perf_counter()
    last = next(frames for frames in progress if frames >= first + options.frames)
    seconds = time.perf_counter() - start
    figures = {"fps": (last - first) / seconds, "frames": last - first, "seconds": seconds}
    print(json.dumps({**figures, "warmup_seconds": start - born, "threads": options.threads}), flush=True)
