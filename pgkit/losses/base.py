"""What every loss here shares: TorchRL's ``LossModule`` contract, written once."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from pgkit.errors import UserError
from pgkit.functional import listed


class Loss(LossModule):
    """A TorchRL ``LossModule`` whose subclass says what it reads and writes in two methods.

    A family's base (:class:`~pgkit.losses.PolicyLoss`, :class:`~pgkit.losses.QLoss`) holds the networks; an algorithm's
    file writes ``forward``.

    Args:
        reduction: ``mean``, ``sum`` or ``none``; None is ``mean``.
    """

    actor_network: TensorDictModule
    actor_network_params: Any
    target_actor_network_params: Any

    def __init__(self, reduction: str | None = None) -> None:
        self._in_keys = self._out_keys = None
        super().__init__()
        self.reduction = "mean" if reduction is None else reduction

    def convert_to_functional(self, module: Any, module_name: str, *args: Any, **kwargs: Any) -> None:
        """As in TorchRL, after a check that ``module`` says what it reads and writes.

        Raises:
            UserError: it is no TensorDict module.
        """
        for network in module if isinstance(module, list | tuple) else [module]:
            if not isinstance(network, TensorDictModuleBase):
                raise UserError(
                    f"{type(self).__name__} takes TensorDict modules, its {module_name} is a {type(network).__name__}: "
                    "wrap it, tensordict.nn.TensorDictModule(net, in_keys=[...], out_keys=[...])"
                )
        super().convert_to_functional(module, module_name, *args, **kwargs)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """``forward``; a ``UserError`` for an empty batch."""
        for batch in args[:1]:
            if isinstance(batch, TensorDictBase) and not batch.batch_size.numel():
                raise UserError(f"{type(self).__name__} got an empty batch {list(batch.batch_size)}: give it rows")
        return super().__call__(*args, **kwargs)

    def __getattr__(self, item: str) -> Any:
        if item.startswith("target_") and item.endswith("_params") and self._modules.get(item) is None:
            return getattr(self, item.removeprefix("target_")).detach()  # LossModule's .data is hidden from a recording
        return super().__getattr__(item)

    def register_buffer(self, name: str, tensor: Tensor | None, persistent: bool = True) -> None:
        """As in torch, on the device of the networks: a CUDA graph takes nothing from another."""
        device = next((p.device for p in self.parameters()), None)
        super().register_buffer(name, tensor if tensor is None else tensor.to(device=device), persistent)

    def _reads(self) -> list[NestedKey]:
        """Every entry that ``forward`` reads; a key may come twice."""
        raise NotImplementedError(f"{type(self).__name__} has no _reads(): return the keys that its forward reads")

    def _writes(self) -> list[NestedKey]:
        """Entries of ``forward``'s result."""
        raise NotImplementedError(f"{type(self).__name__} has no _writes(): return the keys of its forward's result")

    @property
    def in_keys(self) -> list[NestedKey]:
        """Every entry that ``forward`` reads."""
        if self._in_keys is None:
            self._in_keys = list(dict.fromkeys(key for keys in self._reads() for key in listed(keys)))
        return list(self._in_keys)

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey] | None) -> None:
        self._in_keys = keys

    @property
    def out_keys(self) -> list[NestedKey]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Entries of the result."""
        if self._out_keys is None:
            self._out_keys = self._writes()
        return list(self._out_keys)

    @out_keys.setter
    def out_keys(self, keys: list[NestedKey]) -> None:
        self._out_keys = keys

    def set_keys(self, **kwargs: NestedKey) -> None:
        """As in TorchRL: renames the entries the loss reads."""
        super().set_keys(**kwargs)
        self._in_keys = None

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    def reduce(self, loss: Tensor, batch: TensorDictBase) -> Tensor:
        """The unreduced ``[*B]`` or ``[*B, 1]`` as this loss's ``reduction`` wants it, ``[]`` or ``[*B]``.

        Padded entries are left out.
        """
        loss = self._reduce_loss(loss, batch)
        return loss.squeeze(-1) if loss.dim() > batch.dim() else loss

    def average(self, entry: Tensor, batch: TensorDictBase) -> Tensor:
        """The metric ``[]`` of an entry ``[*B]`` or ``[*B, 1]``: its mean without gradient, padded entries left out."""
        return self._reduce_loss(entry.detach(), batch, reduction="mean")


def masks_of(keys: tuple[NestedKey, ...], action: Any, mask_key: Any) -> tuple[NestedKey, ...]:
    """TorchRL's masks, and that of the group whose actions these are: its agents that are gone do not count."""
    first = listed(action)[0]
    grouped = not isinstance(first, str) and mask_key == "auto"
    return (*keys, (*first[:-1], "mask")) if grouped else keys
