"""TorchRL's own tests of its losses, run against pgkit's losses of the same names.

    git clone --depth 1 --branch v0.14.1 https://github.com/pytorch/rl
    python tests/torchrl/run_objective_tests.py rl [--loss ClipPPOLoss] [pytest flags]

Before TorchRL's test files are imported, every class of ``torchrl.objectives`` that ``pgkit.losses`` has by the same
name is replaced by pgkit's; the tests that name such a class are run, all others are left out. The tests are
TorchRL's, unchanged, and stay where they are. Keywords that pgkit's constructors do not have are dropped where they
change nothing (``DROPPED`` below). Where a test leaves a setting to its default, it gets TorchRL's: keywords that both
have, and the value estimator that TorchRL makes when none was. What remains failed, and why: docs/pages/torchrl.md.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from collections import Counter, defaultdict
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torchrl.objectives
from tensordict import TensorDictBase
from torch import Tensor

from pgkit import losses

DROPPED: dict[str, Any] = {
    "device": None, "deactivate_vmap": None, "functional": None, "value_network": None, "delay_value": False,
    "skip_done_states": False, "scalar_output_mode": None,
}  # fmt: skip
"""Keyword and the value at which it asks for nothing; None: at any value."""


def defaults(cls: type) -> dict[str, Any]:
    """Keyword arguments of a class's constructor, and of those of its bases, that have a default."""
    found: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        parameters = inspect.signature(base.__init__).parameters if "__init__" in vars(base) else {}
        found |= {p.name: p.default for p in parameters.values() if p.default is not p.empty}
    return found


def adapted(cls: type, stock: type) -> type:
    """The class, with a constructor that drops the keywords above and has TorchRL's defaults."""
    own, theirs = defaults(cls), defaults(stock)
    other = {name: x for name, x in theirs.items() if name in own and x is not None and x != own[name]}

    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        kept = {name: x for name, x in kwargs.items() if name not in DROPPED or DROPPED[name] not in (None, x)}
        if kwargs.get("value_network") is None:
            kept.pop("delay_value", None)  # of the value network that is not there
        cls.__init__(self, *args, **{**other, **kept})
        make_default(self)

    def make_default(self: Any) -> None:
        self.made = False
        if getattr(self, "critic_network", None) is not None:
            with suppress(KeyError):  # the critic's keys are not set yet
                cls.make_value_estimator(self)
                self.made = True

    def set_keys(self: Any, **kwargs: Any) -> None:
        again = getattr(self, "made", False)
        if again:
            self._value_estimator = None
        cls.set_keys(self, **kwargs)
        if again:
            make_default(self)

    def log_probs(self: Any, tensordict: TensorDictBase) -> Tensor:
        return self.log_prob(self.distribution(tensordict), tensordict)

    members = {
        "__init__": init,
        "set_keys": set_keys,
        "_log_probs": log_probs,
        "__module__": cls.__module__,
        "__doc__": cls.__doc__,
    }
    return type(cls.__name__, (cls,), members)


NAMES = [name for name in losses.__all__ if hasattr(torchrl.objectives, name)]
SUBSTITUTES = {name: adapted(getattr(losses, name), getattr(torchrl.objectives, name)) for name in NAMES}


def substitute(names: list[str]) -> None:
    """Puts pgkit's classes where ``torchrl.objectives`` and the files that define them have TorchRL's."""
    for name in names:
        stock: Any = getattr(torchrl.objectives, name)
        for module in (torchrl.objectives, sys.modules[stock.__module__]):
            setattr(module, name, SUBSTITUTES[name])


class Judge:
    """A pytest plugin: keeps the tests that concern a substituted class, and counts how they end."""

    def __init__(self, names: list[str]) -> None:
        self.names = names
        self.owner: dict[str, str] = {}
        self.counts: dict[str, Counter[str]] = defaultdict(Counter)
        self.reasons: dict[str, Counter[str]] = defaultdict(Counter)

    def concerns(self, item: pytest.Item) -> str | None:
        """Name of the class that a test is about: its ``loss_class``, or the first one its source names."""
        loss_class = getattr(getattr(item, "callspec", None), "params", {}).get("loss_class")
        if loss_class is not None:
            return next((name for name in self.names if loss_class is SUBSTITUTES[name]), None)
        source = inspect.getsource(getattr(item, "function"))  # noqa: B009
        return next((name for name in self.names if re.search(rf"\b{name}\b", source)), None)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        found = [(item, name) for item in items if (name := self.concerns(item))]
        for item, _ in found:
            for (
                node
            ) in item.listchain():  # the class of PPO's tests is skipped without transformers, but has no use for it
                node.own_markers = [mark for mark in node.own_markers if "transformers" not in str(mark.kwargs)]
        items[:] = [item for item, _ in found]
        self.owner = {item.nodeid: name for item, name in found}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or (report.when == "setup" and not report.passed):
            name = self.owner[report.nodeid]
            self.counts[name][report.outcome] += 1
            if report.failed:
                lines = [line.strip() for line in report.longreprtext.splitlines() if line.strip()]
                test = report.nodeid.split("::")[-1].split("[")[0]
                reason = next(
                    (line for line in reversed(lines) if re.match(r"^(E\s+)?\w*(Error|Failed|Exception)", line)), ""
                )
                self.reasons[name][f"{test}: {reason[:160]}"] += 1

    def report(self) -> str:
        """A table of counts, then the reasons of the failures."""
        lines = ["| loss | passed | failed | skipped |", "|---|---|---|---|"]
        for name, count in sorted(self.counts.items()):
            lines.append(f"| `{name}` | {count['passed']} | {count['failed']} | {count['skipped']} |")
        for name, reasons in sorted(self.reasons.items()):
            lines += ["", f"{name}:", *(f"  {number:4d} x {reason}" for reason, number in reasons.most_common())]
        return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("clone", type=Path, help="a clone of pytorch/rl")
    parser.add_argument("--loss", action="append", choices=sorted(SUBSTITUTES), help="only this class; may be repeated")
    args, flags = parser.parse_known_args()
    names = args.loss or sorted(SUBSTITUTES)
    substitute(names)
    judge, folder = Judge(names), args.clone / "test" / "objectives"
    pattern = re.compile("|".join(rf"\b{name}\b" for name in names))
    files = [str(path) for path in sorted(folder.glob("test_*.py")) if pattern.search(path.read_text(encoding="utf-8"))]
    pytest.main(
        ["-q", "--tb=short", "-p", "no:cacheprovider", "-r", "N", f"--rootdir={args.clone}", *flags, *files],
        plugins=[judge],
    )
    print(judge.report())


if __name__ == "__main__":
    main()
