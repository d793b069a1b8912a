"""The KL coefficient: the paper's rule, its bounds, its state; a change compiles nothing again."""

import pytest
import torch

from pgkit import advantages, controllers, envs, losses, modules, updates
from pgkit.functional import adapted_coefficient
from tests.updates.test_on_policy import make_rollout


@pytest.mark.parametrize(("kl", "expected"), [(0.0151, 6.0), (0.0149, 3.0), (0.0067, 3.0), (0.0066, 1.5)])
def test_the_rule_by_hand(kl, expected):
    # target 0.01: doubled above 0.015, halved below 0.00667
    assert adapted_coefficient(torch.tensor(3.0), torch.tensor(kl), 0.01).item() == expected


def test_it_takes_the_mean_stays_within_its_bounds_and_travels():
    block = controllers.AdaptiveKL(0.01, 1.0, increment=3.0, decrement=0.1, bounds=(0.5, 2.0))
    assert block.update(torch.tensor([0.0, 0.04])) == 2.0  # mean 0.02: 3, within bounds 2
    assert block.update(torch.zeros(4)) == 0.5
    again = controllers.AdaptiveKL()
    again.load_state_dict(block.state_dict())
    assert again.beta.item() == 0.5


def test_a_change_reaches_the_compiled_step_and_compiles_nothing_again():
    def agent(mode):
        torch.manual_seed(0)
        env = envs.make("Pendulum-v1")
        actor, critic = modules.gaussian_actor(env), modules.state_value(env)
        penalty = controllers.AdaptiveKL(beta=1.0)
        loss = losses.KLPENPPOLoss(actor, critic, controller=penalty)
        optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3)
        update = updates.OnPolicyUpdate(
            loss, advantages.GAE(critic), optimizer, epochs=2, minibatch_size=32, compile=mode, seed=0
        )
        out, seconds = [], []
        for i in range(3):
            out.append(update(loss.keep_distribution(make_rollout(i))))
            penalty.update(torch.tensor(1.0 if i else 0.0))
            seconds.append(update.compile_seconds)
        assert [row["beta"] for row in out] == [1.0, 0.5, 1.0] and seconds[0] == seconds[2]
        return out

    for a, b in zip(agent("on"), agent("off"), strict=True):
        assert a == pytest.approx(b, rel=1e-3, abs=1e-4)
