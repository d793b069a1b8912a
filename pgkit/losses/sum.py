"""Several losses of one batch as one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule

from pgkit.errors import UserError
from pgkit.losses.base import Loss


class Sum(Loss):
    """Several losses of one batch as one: it has every entry of each, so that an update minimizes their sum.

    ``losses.Sum(SACLoss(actor, critics), Reconstruction(encoder, decoder))``. The parts are pgkit's or TorchRL's; their
    networks, targets and coefficients are this loss's too, under the same names. Where an earlier part has taken the
    name of an entry, a network or a coefficient, the later one's has the part's number: ``loss_actor_2``.
    ``tensor_keys`` are those of the first part.

    Args:
        losses: the parts.

    Raises:
        UserError: there is none, or two parts have a ``gamma`` and do not agree.
    """

    def __init__(self, *losses: LossModule) -> None:
        super().__init__()
        if not losses:
            raise UserError("losses.Sum() has no part: give it losses, Sum(SACLoss(actor, critics), my_loss)")
        self.parts = losses  # no ModuleList: what they hold is registered here by its own name
        self._tensor_keys = losses[0].tensor_keys
        self._hold()
        gammas = [(type(part).__name__, float(part.gamma)) for part in losses if "gamma" in part._buffers]
        if len({gamma for _, gamma in gammas}) > 1:
            said = ", ".join(f"{name} has {gamma:g}" for name, gamma in gammas)
            raise UserError(f"two owners of gamma: {said}; give them the same value")
        updated: dict[str, bool] = {}
        for part in losses:  # whoever moves the targets of the sum tells all of its parts
            for name, done in part._has_update_associated.items():
                updated[name] = updated.get(name, True) and done
            part._has_update_associated = updated
        self._has_update_associated = updated

    def _hold(self) -> None:
        """Registers what the parts hold, by its own name."""
        own = vars(self)
        tables = ("_parameters", "_buffers", "_modules")
        for table in tables:
            own[table].clear()
        taken: set[str] = set()
        for number, part in enumerate(self.parts, 1):
            of_part = vars(part)
            networks = {name: x for name, x in of_part.items() if isinstance(x, nn.Module)}
            held = [(own[table], of_part[table]) for table in tables] + [(own, networks)]
            names = {name: _free(name, taken, number) for _, entries in held for name in entries}
            for names_here, entries in held:
                for name, x in entries.items():
                    own.pop(names[name], None)
                    names_here[names[name]] = x
            taken |= {_network(name) for name in names}

    def _apply(self, fn: Callable[[Tensor], Tensor]) -> Sum:
        for part in self.parts:
            part._apply(fn)
        self._hold()  # a part may have another buffer in the place of the one that it had
        return self

    def set_keys(self, **kwargs: NestedKey) -> None:
        """Renames entries in every part that knows them.

        Raises:
            ValueError: no part knows a name.
        """
        known = {part: kwargs.keys() & part._AcceptedKeys.__dataclass_fields__.keys() for part in self.parts}
        if unknown := kwargs.keys() - set().union(*known.values()):
            raise ValueError(f"no part of the sum has a key '{min(unknown)}'")
        for part, names in known.items():
            part.set_keys(**{name: kwargs[name] for name in names})
        self._in_keys = None

    def _reads(self) -> list[NestedKey]:
        return [key for part in self.parts for key in part.in_keys]

    def _writes(self) -> list[NestedKey]:
        written: list[NestedKey] = []
        for number, part in enumerate(self.parts, 1):
            written += [_free(key, {*written}, number) for key in part.out_keys]
        return written

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Every entry of every part's result for a batch ``[*B]``."""
        out = TensorDict()
        for number, part in enumerate(self.parts, 1):
            taken = set(out.keys())
            for key, value in part(tensordict).items():
                out[_free(key, taken, number)] = value
        return out


def _network(name: str) -> str:
    """The network that parameters or delayed parameters belong to: ``actor`` of ``target_actor_params``."""
    return name.removeprefix("target_").removesuffix("_params")


def _free(name: Any, taken: set[Any], number: int) -> Any:
    """``name``, or where its network's is taken, the same with the part's number after that."""
    network = _network(name)
    return name.replace(network, f"{network}_{number}") if network in taken else name
