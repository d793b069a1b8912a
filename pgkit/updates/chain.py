"""An assembled agent as a chain: which network reads and writes which entry of a batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn


@dataclass
class Chain:
    """Who writes a batch (environment, actor, advantage block) and who reads it (the loss and its networks).

    Args:
        loss: any TorchRL loss.
        advantage: the advantage block, or None.
        source: what hands the batch over: ``the rollout``, or the name of a replay buffer.
    """

    loss: nn.Module
    advantage: Any = None
    source: str = "the rollout"

    @property
    def name(self) -> str:
        """The loss's class."""
        return type(self.loss).__name__

    def networks(self) -> dict[str, tuple[Any, Any]]:
        """``name -> (module, parameters)`` of the networks that a TorchRL loss holds; of a stack the first member."""
        held, children = {}, dict[str, Any](self.loss.named_children())
        for child, params in children.items():
            name = child.removesuffix("_params")
            if name != child and not name.startswith("target_") and hasattr(params, "to_module"):
                held[name] = (getattr(self.loss, name), params[0] if params.batch_dims else params)
        return held

    def writer(self, key: Any) -> str:
        """Who makes ``key``: the advantage block, a network of the loss, or the environment."""
        if key in getattr(self.advantage, "out_keys", ()):
            return type(self.advantage).__name__
        return next((name for name, (net, _) in self.networks().items() if key in net.out_keys), "environment")

    def origin(self, key: Any) -> str:
        """Who makes ``key`` and where it lies, for a message."""
        writer = self.writer(key)
        if key in getattr(self.advantage, "out_keys", ()):
            return writer
        return f"{'the ' * (writer == 'environment')}{writer} (in {self.source})"

    def reader(self, key: Any) -> str:
        """Who takes ``key`` out of the batch."""
        nets = self.readers(key)
        return f"{' and '.join(nets)} of {self.name}" if nets else self.name

    def readers(self, key: Any) -> list[str]:
        """Names of the loss's networks that take ``key`` as an input."""
        return [name for name, (net, _) in self.networks().items() if key in net.in_keys]

    def reads(self) -> list[Any]:
        """The loss's ``in_keys``; of a loss without any, what its networks and a one-step target read."""
        if named := getattr(self.loss, "in_keys", None):
            return list(named)
        inputs = [key for net, _ in self.networks().values() for key in net.in_keys]
        actions = self.keys("action")
        after = [key for key in inputs if key not in actions]
        after += [key for name in ("reward", "done", "terminated") for key in self.keys(name)]
        return list(dict.fromkeys([*inputs, *actions, *map(following, after)]))

    def key(self, name: str) -> Any:
        """The entry that the loss knows as ``name`` (its ``tensor_keys``), or None."""
        return getattr(getattr(self.loss, "tensor_keys", None), name, None)

    def keys(self, name: str) -> list[Any]:
        """The entries of :meth:`key`: none, one, or those of a composite action's parts."""
        key = self.key(name)
        return key if isinstance(key, list) else [] if key is None else [key]

    def distribution(self, batch: TensorDictBase) -> Any:
        """The actor's distribution at the batch's observations; None for an actor without one."""
        net, params = self.networks().get("actor_network", (None, None))
        if not hasattr(net, "get_dist"):
            return None
        return run(net, params, lambda: net.get_dist(batch.select(*net.in_keys, strict=False)))


def run(net: Any, params: Any, call: Callable[[], Any]) -> Any:
    """``call()`` with ``params`` in ``net``, without gradients and without a trace on the random generator."""
    with torch.no_grad(), torch.random.fork_rng(devices=[]), params.to_module(net, preserve_module_state=False):
        return call()


def following(key: Any) -> tuple[str, ...]:
    """The key of the same entry one step on."""
    return ("next", *((key,) if isinstance(key, str) else key))


def show(key: Any) -> str:
    """A key as a user writes it: ``observation``, or ``next.reward``."""
    return key if isinstance(key, str) else ".".join(key)


def shape(x: Tensor) -> str:
    """A shape as ``(64, 1)``."""
    return str(tuple(x.shape))


def is_loss(key: Any) -> bool:
    """Whether an entry of a loss's result is minimized: ``loss_...``, or TorchRL's ``loss`` where it has but one."""
    return isinstance(key, str) and (key == "loss" or key.startswith("loss_"))
