"""A sum of losses: entries, targets, keys and coefficients of each, and an update that trains both."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import nn
from torchrl.objectives import LossModule, SoftUpdate

from pgkit import advantages, collectors, data, envs, losses, modules, updates
from pgkit.errors import UserError
from pgkit.updates.targets import averaging
from tests.losses.test_sac import batch


class Reconstruction(losses.Loss):
    """An auxiliary loss of one's own: a decoder reads what the encoder made of the observation."""

    encoder_network: nn.Module
    decoder_network: nn.Module
    encoder_network_params: TensorDictParams
    decoder_network_params: TensorDictParams
    target_encoder_network_params: TensorDictParams
    target_decoder_network_params: TensorDictParams

    def __init__(self, encoder, decoder):
        super().__init__()
        self.convert_to_functional(encoder, "encoder_network")
        self.convert_to_functional(decoder, "decoder_network")
        self.register_coeff_buffer("weight", 0.5)

    def _reads(self):
        return ["observation"]

    def _writes(self):
        return ["loss_reconstruction", "q_value"]

    def forward(self, tensordict):
        rows = tensordict.select("observation")
        with self.encoder_network_params.to_module(self.encoder_network):
            self.encoder_network(rows)
        with self.decoder_network_params.to_module(self.decoder_network):
            self.decoder_network(rows)
        error = (rows["decoded"] - rows["observation"]).square().mean()
        return TensorDict({"loss_reconstruction": self.weight * error, "q_value": error.detach()})


def parts():
    """SAC whose critics read an encoder, and a reconstruction that trains the same encoder."""
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1")
    encoder = modules.Encoder(env, lambda num, features: ([nn.Linear(features, 5)], 5))
    critics = modules.q_value(env, 2, (8,), encoder=encoder)
    soft = losses.SACLoss(modules.tanh_normal_actor(env, (8,)), critics, gamma=0.5)
    decoder = TensorDictModule(nn.Linear(5, 3), ["features"], ["decoded"])
    return env, soft, Reconstruction(TensorDictModule(encoder, ["observation"], ["features"]), decoder)


def test_it_has_the_entries_of_each_part_and_their_sum_is_minimized():
    _, soft, aux = parts()
    both = losses.Sum(soft, aux)
    SoftUpdate(both, tau=0.1)  # TorchRL's finds the targets by their names, and no part warns
    assert soft._has_update_associated is aux._has_update_associated and all(soft._has_update_associated.values())
    rows = batch()
    torch.manual_seed(1)
    out = both(rows)
    assert "td_error" in rows.keys()
    torch.manual_seed(1)
    alone, other = soft(rows.copy()), aux(rows.copy())
    assert list(out.keys()) == both.out_keys == [*soft.out_keys, "loss_reconstruction", "q_value_2"]
    for key in soft.out_keys:
        torch.testing.assert_close(out[key], alone[key], rtol=0, atol=0)
    assert out["loss_reconstruction"] == other["loss_reconstruction"] and out["q_value_2"] == other["q_value"]
    assert both.in_keys == list(dict.fromkeys([*soft.in_keys, *aux.in_keys]))
    encoder = next(iter(aux.encoder_network_params.values(True, True)))
    grads = [
        torch.autograd.grad(out[key], encoder, retain_graph=True)[0] for key in ("loss_qvalue", "loss_reconstruction")
    ]
    total = sum(out[key] for key in out.keys() if key.startswith("loss_"))
    torch.testing.assert_close(torch.autograd.grad(total, encoder)[0], sum(grads))


def test_parameters_are_each_there_once_and_the_state_is_that_of_the_parts():
    _, soft, aux = parts()
    both = losses.Sum(soft, aux)
    expected = {id(p) for part in (soft, aux) for p in part.parameters()}
    assert len(list(both.parameters())) == len(expected) and {id(p) for p in both.parameters()} == expected
    assert set(both.state_dict()) == {*soft.state_dict(), *aux.state_dict()}
    other = losses.Sum(*parts()[1:])
    for p in other.parameters():
        p.data.zero_()
    other.load_state_dict(both.state_dict())
    for x, y in zip(other.parameters(), both.parameters(), strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=0)


def test_a_change_of_type_and_of_a_coefficient_reaches_the_parts():
    _, soft, aux = parts()
    both = losses.Sum(soft, aux).double()
    assert both.gamma is soft.gamma and both.weight is aux.weight and aux.weight.dtype == torch.float64
    both.gamma.fill_(0.25)
    assert soft.gamma == 0.25
    both.set_keys(reward="pay")
    assert soft.tensor_keys.reward == both.tensor_keys.reward == "pay" and ("next", "pay") in both.in_keys
    with pytest.raises(ValueError, match="no part of the sum has a key 'other'"):
        both.set_keys(other="x")


def test_targets_of_every_part_move_also_where_two_have_one_name():
    env = envs.make("Pendulum-v1")
    soft = [
        losses.SACLoss(modules.tanh_normal_actor(env, (8,)), modules.q_value(env, 2, (8,)), delay_actor=d)
        for d in (0, 1)
    ]
    both = losses.Sum(*soft)
    names = [name for name, _ in both.named_children() if name.startswith("target_")]
    wanted = ["target_qvalue_network_params", "target_actor_network_2_params", "target_qvalue_network_2_params"]
    assert sorted(names) == sorted(wanted)
    with torch.no_grad():
        for p in both.parameters():
            p.add_(1.0)
    average = averaging(both, 1.0)
    assert average is not None
    average(torch.tensor(True))
    for part in soft:
        for name in ("actor_network", "qvalue_network") if part.delay_actor else ("qvalue_network",):
            pair: Any = part._modules[f"target_{name}_params"], part._modules[f"{name}_params"]
            for x, y in zip(*(net.values(True, True) for net in pair), strict=True):
                torch.testing.assert_close(x, y.data)
    assert both.gamma_2 is soft[1].gamma and both.actor_network_2 is soft[1].actor_network
    rows = batch()
    assert {"loss_actor", "loss_actor_2", "loss_qvalue_2"} <= set(both(rows).keys())


@pytest.mark.parametrize("n_steps", [1, 3])
def test_an_update_trains_it_and_checks_it(n_steps):
    env, soft, aux = parts()
    both = losses.Sum(soft, aux)
    update = updates.OffPolicyUpdate(
        both, data.ReplayBuffer(env, 500, n_steps=n_steps, seed=0), torch.optim.Adam(both.parameters(), lr=1e-2),
        batch_size=32, learning_starts=64, compile="off", actor_delay=2,
    )  # fmt: skip
    collector = collectors.VectorCollector(env, soft.actor_network, frames_per_batch=64, compile="off")
    target = soft.target_qvalue_network_params["module", "layers", "0", "weight"].clone()
    first, *_, last = [update(collector.rollout()) for _ in range(3)]
    assert last["loss_reconstruction"] < first["loss_reconstruction"] and "alpha" in last and "q_value_2" in last
    assert not torch.equal(target, soft.target_qvalue_network_params["module", "layers", "0", "weight"])
    assert "Sum" in str(update)


def test_an_advantage_is_for_the_part_that_reads_it():
    env = envs.make("Pendulum-v1")
    actor, critic = modules.gaussian_actor(env, (8,)), modules.state_value(env, (8,))

    class Cloning(losses.PolicyLoss):
        def _reads(self):
            return [*self.actor_network.in_keys, "action"]

        def _writes(self):
            return ["loss_cloning"]

        def forward(self, tensordict):
            log_prob = self.distribution(tensordict).log_prob(tensordict["action"])
            return TensorDict({"loss_cloning": -log_prob.mean()})

    both = losses.Sum(losses.ClipPPOLoss(actor, critic), Cloning(actor))
    optimizer = torch.optim.Adam(both.parameters(), lr=1e-2)
    update = updates.OnPolicyUpdate(both, advantages.GAE(critic), optimizer, epochs=1, compile="off")
    metrics = update(collectors.VectorCollector(env, actor, frames_per_batch=64, compile="off").rollout())
    assert {"loss_objective", "loss_critic", "loss_cloning"} <= set(metrics)


def test_refusals():
    _, soft, _ = parts()
    with pytest.raises(UserError, match="has no part"):
        losses.Sum()
    other = losses.SACLoss(soft.actor_network, soft.qvalue_network, gamma=0.9)
    with pytest.raises(UserError, match="two owners of gamma: SACLoss has 0.5, SACLoss has 0.9"):
        losses.Sum(soft, other)


def test_it_is_a_loss_module():
    _, soft, aux = parts()
    both = losses.Sum(soft, aux)
    SoftUpdate(both, tau=0.1)
    assert isinstance(both, LossModule)
    both.select_out_keys("loss_qvalue", "loss_reconstruction")
    assert set(both(batch()).keys()) == {"loss_qvalue", "loss_reconstruction"}
