"""TRPO's surrogate, by hand."""

import math

import pytest
import torch

from pgkit import losses
from tests.losses.test_kl_pen_ppo import by_hand


def test_values_and_gradient_by_hand():
    # as PPO-penalty's test without the penalty: ratios 2, 2 exp(1/8); A = 1, -3; slope of the objective in w: 1
    actor, _, batch = by_hand()
    out = losses.TRPOLoss(actor, entropy_coeff=0.25)(batch)
    assert out["loss_objective"].item() == pytest.approx(-(1 - 3 * math.exp(1 / 8)), abs=1e-12)
    entropy = 0.5 + 0.5 * math.log(2 * math.pi)
    assert out["loss_entropy"].item() == pytest.approx(-0.25 * entropy, abs=1e-12)
    (slope,) = torch.autograd.grad(out["loss_objective"], list(actor.parameters()))
    assert slope.item() == pytest.approx(-1.0, abs=1e-12)


def test_shapes_never_broadcast():
    actor, _, batch = by_hand()
    with pytest.raises(ValueError, match=r"old_log_prob has shape \(2, 1\) but log_prob has shape \(2,\)"):
        losses.TRPOLoss(actor)(batch.set("action_log_prob", batch["action_log_prob"].unsqueeze(-1)))
