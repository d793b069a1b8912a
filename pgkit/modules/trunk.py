"""What actors and critics share: a normalizer, then hidden layers or an encoder, then a head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.errors import UserError
from pgkit.modules.mlp import mlp
from pgkit.modules.sizes import observation_shape, observation_size


def trunk(
    env: EnvBase,
    hidden: Sequence[int],
    activation: type[nn.Module],
    normalizer: nn.Module | None = None,
    encoder: nn.Module | None = None,
) -> tuple[list[nn.Module], int]:
    """The modules before a head, and how many features they give for an observation of ``env``."""
    if encoder is None:
        encoder = mlp(observation_size(env), None, hidden, activation)
        features = hidden[-1] if hidden else observation_size(env)
    elif normalizer is not None and reads(encoder) != ["observation"]:
        raise UserError(
            f"normalizer= is for the one entry 'observation', the encoder reads {', '.join(map(str, reads(encoder)))}: "
            "put normalizers into the encoders of single entries (nn.Sequential(normalizer, encoder))"
        )
    else:
        examples = [_zero(env, encoder, key) for key in reads(encoder)]
        modes = {module: module.training for module in encoder.modules()}
        encoder.eval()  # a batch of zeros is no statistic
        try:
            with torch.no_grad():
                features = first(encoder(*examples)).shape[-1]
        except (RuntimeError, ValueError, TypeError) as error:
            found = ", ".join(str(tuple(x.shape)) for x in examples)
            raise UserError(
                f"encoder={type(encoder).__name__} cannot take an observation {found}: {str(error).splitlines()[0]}"
            ) from error
        finally:
            for module, training in modes.items():
                module.training = training
    return [encoder] if normalizer is None else [normalizer, encoder], features


def headed(
    layers: Sequence[nn.Module], head: nn.Module, out_keys: Sequence[NestedKey], head_keys: Sequence[NestedKey] = ()
) -> TensorDictModule:
    """The network of ``trunk`` and ``head`` as a TensorDict module; ``head_keys`` are further inputs of the head."""
    keys = reads(layers[-1])
    if not head_keys and keys == ["observation"]:
        return TensorDictModule(nn.Sequential(*layers, head), in_keys=keys, out_keys=[*out_keys])
    encoder = layers[0] if len(layers) == 1 else nn.Sequential(*layers)
    states = [] if out_keys == ["state_value"] else getattr(layers[-1], "out_keys", [])
    net = Headed(encoder, head, len(keys), len(states))
    return TensorDictModule(net, in_keys=[*keys, *head_keys], out_keys=[*out_keys, *states])


class Headed(nn.Module):
    """An encoder of ``inputs`` tensors and a head of its features; a recurrent encoder's ``states`` come out last."""

    def __init__(self, encoder: nn.Module, head: nn.Module, inputs: int, states: int) -> None:
        super().__init__()
        self.encoder, self.head, self.inputs, self.states = encoder, head, inputs, states

    def forward(self, *inputs: Tensor) -> Any:
        encoded = self.encoder(*inputs[: self.inputs])
        out = self.head(first(encoded), *inputs[self.inputs :])
        return (*(out if isinstance(out, tuple) else (out,)), *encoded[1:]) if self.states else out


def reads(encoder: nn.Module) -> list[NestedKey]:
    """Entries an encoder is called with: its ``in_keys``, or the observation."""
    return list(getattr(encoder, "in_keys", ["observation"]))


def first(out: Any) -> Tensor:
    """The features among an encoder's results."""
    return out[0] if isinstance(out, tuple) else out


def _zero(env: EnvBase, encoder: Any, key: NestedKey) -> Tensor:
    """An example ``[1, ...]`` of what an encoder reads."""
    if key == "is_init":
        return torch.ones(1, 1, dtype=torch.bool)
    if key == "recurrent_state":
        return torch.zeros(1, encoder.state_size)
    observation_shape(env, key)  # a UserError names the entries that there are
    return env.observation_spec_unbatched[key].zero().unsqueeze(0)
