"""A policy as one function of tensors, and as a file of that function: ONNX, or torch.export's."""

from __future__ import annotations

import contextlib
import importlib
import io
import warnings
from collections.abc import Iterator
from logging import ERROR, getLogger
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import DistributionalQValueModule

from pgkit import files
from pgkit.envs.spaces import ToEnv
from pgkit.errors import UserError
from pgkit.run.policy import Policy, dotted
from pgkit.seams import Key

OPSET = 20


class Acts(nn.Module):
    """A policy's likeliest actions: ``(*entries [N, ...]) -> action [N, ...]``, as the environment takes them.

    With a memory it also takes ``is_init`` (bool ``[N, 1]``, an episode begins) and ``recurrent_state``
    (``[N, ...]``), and also returns the state after the step.

    Attributes:
        names: of the inputs, a nested key joined by dots.
        results: names of the outputs.
    """

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        memory, actor = policy.memory, cast(Any, policy.actor)
        self.actor, self.key, self.keys = policy.actor, policy.action_key, list(policy.shapes)
        self.after: Key | None = None
        if memory is not None:
            self.keys += ["is_init", memory.state_key]
            self.after = next(key for key in actor.out_keys if key[-1] == "recurrent_state")
        self.names = [dotted(key) for key in self.keys]
        self.results = ["action", "next_recurrent_state"] if memory is not None else ["action"]
        self.bounds = InBounds(policy.to_env)

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        out = self.actor(TensorDict(dict(zip(self.keys, inputs, strict=True)), []))
        action = self.bounds(out[self.key])
        return action if self.after is None else (action, out[self.after])


class InBounds(nn.Module):
    """:class:`~pgkit.envs.spaces.ToEnv` on tensors: ``[N, ...]`` clipped, rounded, of the environment's type."""

    low: Tensor
    high: Tensor
    start: Tensor

    def __init__(self, to_env: Any) -> None:
        super().__init__()
        if not isinstance(to_env, ToEnv | None):
            raise UserError(f"the environment converts actions by its own {to_env!r:.60}, which cannot be exported")
        self.given = to_env or ToEnv()
        self.bounded = self.given.low is not None and self.given.high is not None
        self.dtype = None if self.given.dtype is None else getattr(torch, str(self.given.dtype))
        for name in ("low", "high") if self.bounded else ():
            self.register_buffer(name, torch.as_tensor(getattr(self.given, name)).to(torch.float32))
        self.shifted = bool(np.any(np.asarray(self.given.start) != 0))
        self.register_buffer("start", torch.as_tensor(self.given.start))

    def forward(self, action: Tensor) -> Tensor:
        if self.bounded:
            action = torch.minimum(torch.maximum(action, self.low), self.high)
            action = action if self.dtype is None or self.dtype.is_floating_point else action.round()
        elif self.shifted:
            action = action + self.start
        return action if self.dtype is None else action.to(self.dtype)


def example(policy: Policy, rows: int = 2) -> tuple[Tensor, ...]:
    """Inputs of :class:`Acts`, ``[rows, ...]``: random observations, at the first step of episodes."""
    generator, entries = torch.Generator().manual_seed(0), []
    for key, shape in policy.shapes.items():
        dtype = getattr(torch, policy.dtype(key))
        numbers = torch.randn(rows, *shape, generator=generator)
        entries.append(numbers.abs().mul(60).clamp(0, 255).to(dtype) if dtype == torch.uint8 else numbers.to(dtype))
    if policy.memory is not None:
        entries += [torch.ones(rows, 1, dtype=torch.bool), torch.zeros(rows, *policy.memory.state_shape)]
    return tuple(entries)


def program(policy: Policy) -> tuple[torch.export.ExportedProgram, Acts]:
    """The policy as a graph of torch.export, with any number of rows."""
    acts, inputs = Acts(policy).eval(), example(policy)
    rows = ({0: torch.export.Dim("rows", min=1)},) * len(inputs)
    try:
        with _traceable(), set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            return torch.export.export(acts, inputs, dynamic_shapes=(rows,), strict=False), acts
    except Exception as error:  # whatever a network of the user's own does
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise UserError(f"torch.export cannot trace this policy: {reason}") from error


def write_pt2(policy: Policy, file: Path) -> None:
    """``torch.export.load(file).module()(*entries)`` gives the actions."""
    exported, _ = program(policy)
    memory = io.BytesIO()
    torch.export.save(exported, memory)
    with files.replacing(file) as target:
        target.write(memory.getvalue())


def write_onnx(policy: Policy, file: Path) -> None:
    """One ONNX file with its weights inside."""
    for name in ("onnx", "onnxscript"):
        needs(name, "export")
    exported, acts = program(policy)
    with _traceable():
        made = torch.onnx.export(
            exported, input_names=acts.names, output_names=acts.results, opset_version=OPSET, verbose=False
        )
    assert made is not None
    with files.replacing(file) as target:
        target.write(made.model_proto.SerializeToString())


def needs(package: str, extra: str) -> Any:
    """A package of an extra.

    Raises:
        UserError: it is not installed; with the install line.
    """
    try:
        return importlib.import_module(package)
    except ImportError:
        raise UserError(f'this needs {package}: pip install "pgkit-rl[{extra}]"') from None


@contextlib.contextmanager
def _traceable() -> Iterator[None]:
    """Nobody checks values, which a graph cannot, and the exporters keep what they would say to themselves."""
    loud, checks = getLogger("torch.onnx"), Distribution._validate_args
    expected = DistributionalQValueModule._support_expected
    DistributionalQValueModule._support_expected = _expected
    level = loud.level
    loud.setLevel(ERROR)
    Distribution.set_default_validate_args(False)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        Distribution.set_default_validate_args(checks)
        DistributionalQValueModule._support_expected = expected
        loud.setLevel(level)


def _expected(module: Any, log_probs: Tensor, support: Tensor | None = None) -> Tensor:
    """TorchRL's mean of a return's distribution, ``[N, atoms, actions]`` to ``[N, actions]``, without its check."""
    atoms: Tensor = module.support if support is None else support
    return (log_probs.exp() * atoms.unsqueeze(-1)).sum(-2)
