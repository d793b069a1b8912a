"""The one place outside ``losses`` that looks into a loss: what it holds, reads and writes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase, is_tensorclass
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from pgkit.checks.keys import following, group
from pgkit.errors import UserError


class LossView:
    """A loss with what comes before it: who writes a batch, and who reads it.

    The loss is any of TorchRL's, of pgkit's, or a module that returns ``loss_*`` entries and has none of what is asked
    for here: then there is nothing to find.

    Args:
        loss: the loss.
        advantage: the advantage block, or None.
        source: what hands the batch over: ``the rollout``, or the name of a replay buffer.

    Attributes:
        name, advantage_name: what a message calls the two.
        in_keys: what the loss says it reads; nothing where it does not say.
        inputs: what the loss's networks read.
        estimates: what the advantage block writes.
    """

    def __init__(self, loss: nn.Module, advantage: Any = None, source: str = "the rollout") -> None:
        self.loss, self.advantage, self.source = loss, advantage, source
        self.name, self.advantage_name = name_of(loss), name_of(advantage)
        self.in_keys = keys_of(loss, "in_keys")
        self.inputs = list(dict.fromkeys(key for net, _ in self.networks().values() for key in net.in_keys))
        expected = [] if advantage is None else [*self.keys("advantage"), *self.keys("value_target")]
        self.estimates = keys_of(advantage, "out_keys") or expected  # of a function: what the loss expects of it

    @property
    def out_keys(self) -> list[Any]:
        """Entries of the loss's result; nothing where it does not say."""
        return keys_of(self.loss, "out_keys")

    def networks(self) -> dict[str, tuple[Any, Any]]:
        """``name -> (module, parameters)`` of the networks that a TorchRL loss holds; of a stack the first member."""
        held, modules = {}, vars(self.loss)
        for child, params in self.loss.named_children():
            name = child.removesuffix("_params")
            if name in modules and not name.startswith("target_") and isinstance(params, TensorDictParams):
                held[name] = (modules[name], params[0] if params.batch_dims else params)
        return held

    def parameters(self, network: str) -> list[Tensor]:
        """All parameters and buffers of a network of this name; none if the loss has no such network."""
        params = self.networks().get(network, (None, None))[1]
        return [] if params is None else list(params.values(True, True))

    def delayed(self) -> list[tuple[str, TensorDictBase, TensorDictBase]]:
        """``(name, target, source)``, the parameters of each network that has a target network.

        The loss is told that its targets are taken care of, as TorchRL's ``SoftUpdate`` does.
        """
        if isinstance(self.loss, LossModule):
            self.loss._has_update_associated.update(dict.fromkeys(self.loss._has_update_associated, True))
        children = dict[str, Any](self.loss.named_children())
        names = [name.removesuffix("_params") for name in children if name.endswith("_params")]
        targets = [name for name in names if f"target_{name}" in names]
        return [(name, children[f"target_{name}_params"], children[f"{name}_params"]) for name in targets]

    def distribution(self, batch: TensorDictBase) -> Any:
        """The actor's distribution at the batch's observations; None for an actor without one."""
        net, params = self.networks().get("actor_network", (None, None))
        if not isinstance(net, ProbabilisticTensorDictSequential):
            return None
        return run(net, params, lambda: net.get_dist(batch.select(*net.in_keys, strict=False)))

    def key(self, name: str) -> Any:
        """The entry that the loss knows as ``name`` (its ``tensor_keys``), or None."""
        return getattr(self.loss.tensor_keys, name, None) if isinstance(self.loss, LossModule) else None

    def keys(self, name: str) -> list[Any]:
        """The entries of :meth:`key`: none, one, or those of a composite action's parts."""
        key = self.key(name)
        return key if isinstance(key, list) else [] if key is None else [key]

    @property
    def distribution_keys(self) -> list[Any]:
        """Parameters of the actor's distribution, as an entry each."""
        net, _ = self.networks().get("actor_network", (None, None))
        return list(net.dist_params_keys) if isinstance(net, ProbabilisticTensorDictSequential) else []

    @property
    def masks(self) -> list[Any]:
        """Where a mask of the rows that count may lie: TorchRL's, the loss's own, or a group's."""
        own = self.loss.loss_mask_key if isinstance(self.loss, LossModule) else None
        read = (*self.keys("action"), *self.keys("advantage"), *self.in_keys)  # the last: of a sum of several groups'
        groups = [group(key) for key in read if group(key)]
        named = [] if own in (None, "auto") else [own]
        return [("collector", "mask"), "shifted_valid", *named, *dict.fromkeys((*path, "mask") for path in groups)]

    def counting(self, data: TensorDictBase, x: Tensor, key: Any) -> Tensor | None:
        """Which elements of ``x [*B, ...]`` count, bool, by the masks at the root and in the group of ``key``.

        None where there is no mask: all of them.
        """
        places = ((), ("collector",), group(key))
        found = [data[mask] for mask in self.masks if group(mask) in places and mask in data.keys(True)]
        return torch.stack([LossModule._expand_loss_mask(mask, x) for mask in found]).all(0) if found else None

    def reads(self) -> list[Any]:
        """The loss's ``in_keys``; of a loss without any, what its networks and a one-step target read."""
        if self.in_keys:
            return [*self.in_keys]
        actions = self.keys("action")
        after = [key for key in self.inputs if key not in actions]
        after += [key for name in ("reward", "done", "terminated") for key in self.keys(name)]
        return list(dict.fromkeys([*self.inputs, *actions, *map(following, after)]))

    def readable(self, data: TensorDictBase) -> list[Any]:
        """Entries of ``data`` that the loss may read: its ``in_keys``, its configurable keys, masks; those present."""
        present = set(data.keys(True, True))
        keys = [*(self.in_keys or present)]
        if isinstance(self.loss, LossModule):
            keys += [key for field in fields(self.loss.tensor_keys) for key in self.keys(field.name)]
        keys += [*self.masks, *self.distribution_keys, "steps_to_next_obs"]  # the last: read by TorchRL's estimators
        return [key for key in dict.fromkeys(keys) if key in present]

    def readers(self, key: Any) -> list[str]:
        """Names of the loss's networks that take ``key`` as an input."""
        return [name for name, (net, _) in self.networks().items() if key in net.in_keys]

    def reader(self, key: Any) -> str:
        """Who takes ``key`` out of the batch."""
        nets = self.readers(key)
        return f"{' and '.join(nets)} of {self.name}" if nets else self.name

    def writer(self, key: Any) -> str:
        """Who makes ``key``: the advantage block, a network of the loss, or the environment."""
        if key in self.estimates:
            return self.advantage_name
        return next((name for name, (net, _) in self.networks().items() if key in net.out_keys), "environment")

    def origin(self, key: Any) -> str:
        """Who makes ``key`` and where it lies, for a message."""
        if key in self.estimates:
            return self.advantage_name
        writer = self.writer(key)
        return f"{'the environment' if writer == 'environment' else writer} (in {self.source})"

    @property
    def gamma(self) -> Any:
        """The loss's discount: its own ``gamma``, or its value estimator's."""
        own = getattr(self.loss, "gamma", None)
        if own is not None:
            return own
        if not isinstance(self.loss, LossModule):
            raise UserError(f"n-step returns are discounted by the loss's gamma: give {self.name} one")
        return self.loss.value_estimator.gamma

    @property
    def priority(self) -> Any:
        """Where the loss writes the priorities of a batch."""
        return self.key("priority") or "td_error"

    @property
    def recordable(self) -> bool:
        """Whether the advantage block says that it may be recorded as tensor operations."""
        return bool(setting(self.advantage, "recordable"))

    def coefficients(self) -> dict[str, Tensor]:
        """The loss's coefficients that can change under way, by name."""
        return dict(self.loss.named_buffers(recurse=False))

    @property
    def estimator(self) -> Any:
        """The value estimator inside a TorchRL loss (``make_value_estimator``), or None."""
        return self.loss._value_estimator if isinstance(self.loss, LossModule) else None

    @estimator.setter
    def estimator(self, estimator: Any) -> None:
        self.loss._value_estimator = estimator

    def lacks_advantage(self, data: TensorDictBase) -> bool:
        """Whether this is a loss of a policy that has a key for an advantage, and ``data`` has no such entry."""
        key = self.key("advantage")
        return key is not None and key not in data.keys(True) and "actor_network" in self.networks()

    def estimated(self, rollout: TensorDictBase, block: Callable[[TensorDictBase], Any] | None) -> TensorDictBase:
        """The rollout ``[num_envs, T]`` with what ``block`` writes, the advantage block or a faster form of it.

        Without one, a loss that was given an estimator uses it here, on the rollout: in the loss it would take a
        minibatch's rows for steps.

        Raises:
            UserError: the rollout is empty, or the block returns no TensorDict.
        """
        if not rollout.batch_size.numel():  # numel() of a TensorDict is at least 1
            raise UserError(f"the rollout {shape_of(rollout)} is empty: collect at least one step of one environment")
        if block is not None:
            result: Any = block(rollout)
            if not isinstance(result, TensorDictBase):
                raise UserError(
                    f"the advantage block {self.advantage_name} returned a {type(result).__name__}: return the "
                    "rollout, with 'advantage' and 'value_target' in it"
                )
            return result
        if self.estimator is None or not self.lacks_advantage(rollout):
            return rollout
        rollout = rollout.copy()  # the next epoch finds none there, and estimates again if it is to
        params = self.networks().get("critic_network", (None, None))[1]
        target = dict(self.loss.named_children()).get("target_critic_network_params", params)
        with torch.no_grad():
            self.estimator(
                rollout,
                params=None if params is None else params.detach(),
                target_params=None if target is None else target.detach(),
            )
        return rollout


def result_of(loss: nn.Module, batch: TensorDictBase) -> Any:
    """What the loss returns for a batch; TorchRL's ``GRPOLoss`` has a class of its own for a TensorDict."""
    out = loss(batch)
    return out.to_tensordict() if is_tensorclass(out) else out


def name_of(block: Any) -> str:
    """What a message calls a block: a function by its own name, any other by its class."""
    while isinstance(block, partial):
        block = block.func
    return getattr(block, "__name__", type(block).__name__)


def setting(owner: Any, name: str) -> float | None:
    """A number that a block holds under a name, such as ``gamma``; None if it holds none."""
    value = getattr(owner, name, None)
    return None if value is None else float(value)


def device_of(data: TensorDictBase) -> torch.device:
    """Where the tensors are; a TensorDict need not say it."""
    return data.device or next(iter(data.values(True, True))).device


def shape_of(data: TensorDictBase) -> str:
    """The batch size as ``[4, 32]``."""
    return str(list(data.batch_size))


def bounds(dist: Any) -> tuple[Any, Any]:
    """Least and greatest action of a distribution, as far as it knows them; else None."""
    low, high, logits = (getattr(dist, name, None) for name in ("low", "high", "logits"))
    if low is None and logits is not None and not dist.sample().is_floating_point():
        return 0, logits.shape[-1] - 1
    return low, high


def run(net: Any, params: Any, call: Callable[[], Any]) -> Any:
    """``call()`` with ``params`` in ``net``, without gradients and without a trace."""
    held = list(params.values(True, True))
    copies = params.apply(lambda x: x if isinstance(x, nn.Parameter) else x.clone())  # statistics may move in these
    cards = list({tensor.device for tensor in held if tensor.is_cuda})
    with torch.no_grad(), torch.random.fork_rng(devices=cards), copies.to_module(net, preserve_module_state=False):
        return call()


def keys_of(block: Any, name: str) -> list[Any]:
    """The ``in_keys`` or ``out_keys`` of a block; none of a function."""
    return list(getattr(block, name, None) or ())
