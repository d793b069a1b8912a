"""Action values of all discrete actions at once: an ensemble of critics as one batched network."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase

from pgkit.errors import UserError
from pgkit.modules.bodies import Body, Norm, ensemble_mlp
from pgkit.modules.ensemble import EnsembleLinear
from pgkit.modules.sizes import observation_size


def discrete_q_value(
    env: EnvBase,
    num_critics: int = 2,
    hidden: Sequence[int] = (256, 256),
    activation: type[nn.Module] = nn.ReLU,
    *,
    norm: Norm | None = None,
    dropout: float = 0.0,
    body: Body | None = None,
    normalizer: nn.Module | None = None,
) -> TensorDictModule:
    """Values of every action: ``observation [*B, obs] -> action_value [*B, num_critics, actions]``.

    All critics are evaluated by one batched matrix product a layer. TorchRL's losses stack their critics themselves:
    give those a list of single ones, ``[*B, actions]`` each.

    Args:
        env: an environment with one discrete action; sizes come from its specs.
        num_critics, hidden, activation, norm, dropout, body, normalizer: as in :func:`~pgkit.modules.q_value`.
    """
    spec = env.action_spec_unbatched
    actions = getattr(spec.space, "n", None)
    if spec.dtype.is_floating_point or actions is None:
        raise UserError(
            f"discrete_q_value needs one discrete action, the environment's is {type(spec).__name__}: "
            "use modules.q_value for a continuous one"
        )
    features = observation_size(env)
    if body is None:
        layers, features = ensemble_mlp(num_critics, features, hidden, activation, norm, dropout)
    else:
        layers, features = body(num_critics, features)
    layers.append(EnsembleLinear(num_critics, features, int(actions), gain=1.0))
    net = DiscreteCritics(layers, num_critics, int(actions), normalizer)
    return TensorDictModule(net, in_keys=["observation"], out_keys=["action_value"])


class DiscreteCritics(nn.Module):
    """Critics side by side: ``[*B, obs] -> [*B, num_critics, actions]``."""

    def __init__(
        self, layers: Sequence[nn.Module], num_critics: int, actions: int, normalizer: nn.Module | None
    ) -> None:
        super().__init__()
        self.num_critics, self.actions, self.normalizer = num_critics, actions, normalizer
        self.layers = nn.Sequential(*layers)

    def forward(self, observation: Tensor) -> Tensor:
        x = observation if self.normalizer is None else self.normalizer(observation)
        q = self.layers(x.reshape(-1, x.shape[-1]).expand(self.num_critics, -1, -1))
        return q.transpose(0, 1).reshape(*x.shape[:-1], self.num_critics, self.actions)
