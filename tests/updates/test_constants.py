"""What a loss holds besides its parameters, in a compiled step."""

from functools import partial
from typing import Any

import pytest
import torch
from torch import nn

from pgkit.compiled import Constants
from pgkit.errors import UserError
from tests.updates.test_on_policy import make_agent, make_rollout, parameters

BOUND = 0.1


class Surrogate:
    def __init__(self):
        self.power, self.calls = 1.0, 0

    def __call__(self, log_ratio, advantage):
        self.calls += 1
        return log_ratio.exp() ** self.power * advantage


def loss_with(surrogate):
    loss = nn.Module()
    loss.surrogate, loss.net = surrogate, nn.Sequential(nn.Dropout(0.1))
    return loss


def constants_of(module):
    return Constants({"it": module})


def test_what_a_callable_closes_over_is_seen(monkeypatch):
    scale = 1.0

    def surrogate(log_ratio, advantage):
        return scale * log_ratio.clamp(max=BOUND) * advantage

    kept = Surrogate()
    for held in (surrogate, partial(surrogate), kept, kept.__call__):
        assert constants_of(loss_with(held)).changed() is None
    for held in (surrogate, partial(surrogate)):
        constants = constants_of(loss_with(held))
        scale = 0.5
        assert constants.changed() == "in it 'surrogate.scale' went from 1.0 to 0.5"
        scale = 1.0
    constants = constants_of(loss_with(surrogate))
    monkeypatch.setitem(globals(), "BOUND", 0.2)
    assert constants.changed() == "in it 'surrogate: BOUND' went from 0.1 to 0.2"
    for held in (kept, kept.__call__):
        constants = constants_of(loss_with(held))
        kept.power += 1
        assert "power' went from" in str(constants.changed())
    constants = Constants({"the augmentation": surrogate})  # a function that is watched itself
    scale = 2.0
    assert "in the augmentation '.scale' went from 1.0 to 2.0" in str(constants.changed())


def test_modules_within_modules_are_seen():
    loss = loss_with(torch.exp)
    constants, dropout = constants_of(loss), loss.get_submodule("net.0")
    dropout.p = 0.2
    assert constants.changed() == "in it 'net.0.p' went from 0.1 to 0.2"
    constants = constants_of(loss)
    loss.eval()
    assert "training' went from True to False" in str(constants.changed())
    constants = constants_of(loss)
    loss.surrogate = partial(torch.exp)
    assert "'surrogate' went from <built-in method exp" in str(constants.changed())
    constants, hidden = constants_of(loss), nn.Dropout(0.1)
    vars(loss)["hidden"] = hidden  # as a TorchRL loss holds its networks
    constants = constants_of(loss)
    hidden.p = 0.3
    assert constants.changed() == "in it 'hidden.p' went from 0.1 to 0.3"


class Config:
    def __init__(self, weight):
        self.weight = weight


class Own(nn.Module):
    """Holds things in many ways."""

    def __init__(self):
        super().__init__()
        self.table, self.row, self.name, self._hidden = {"weight": 1.0}, [1.0, 2.0], "a", 1.0
        self.scale, self.net, self.log, self.config = torch.tensor(1.0), nn.Linear(2, 2), [], Config(1.0)
        self.register_buffer("beta", torch.tensor(1.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda own: own.table.update(weight=2.0), "'table.weight' went from 1.0 to 2.0"),
        (lambda own: setattr(own, "table", {"weight": 2.0}), "'table.weight' went from 1.0 to 2.0"),
        (lambda own: own.row.__setitem__(1, 3.0), "'row.1' went from 2.0 to 3.0"),
        (lambda own: setattr(own.config, "weight", 3.0), "'config.weight' went from 1.0 to 3.0"),
        (lambda own: setattr(own, "config", Config(3.0)), "'config.weight' went from 1.0 to 3.0"),
        (lambda own: setattr(own, "name", "b"), "'name' went from a to b"),
        (lambda own: setattr(own, "_hidden", 2.0), "'_hidden' went from 1.0 to 2.0"),
        (lambda own: setattr(own, "scale", torch.tensor(2.0)), "'scale' went from one Tensor to one Tensor"),
        (lambda own: setattr(own, "beta", own.beta * 2), "'beta' went from one Tensor to one Tensor"),
        (lambda own: setattr(own, "net", nn.Linear(2, 2)), "'net' went from one Linear to one Linear"),
        (lambda own: setattr(own.net.weight, "data", own.net.weight.data * 2), "memory of a parameter or buffer"),
        (lambda own: own.net.weight.data.mul_(2), None),
        (lambda own: own.scale.fill_(2.0), None),
        (lambda own: own.log.append(1.0), None),
    ],
)
def test_what_is_replaced_is_seen_and_what_is_written_into_is_not(change, message):
    own = Own()
    constants = constants_of(own)
    assert constants.changed() is None
    change(own)
    if message is None:
        assert constants.changed() is None
    else:
        assert message in str(constants.changed())
        assert "memory" in message or message in str(constants.changed(memory=False))


def test_what_changes_between_updates_takes_effect_with_a_word(caplog):
    compiled, eager = (make_agent(compile=c, epochs=1, dtype=torch.float64) for c in ("on", "off"))
    scale = 1.0
    for update in (compiled, eager):
        update.loss.surrogate = lambda log_ratio, advantage: scale * log_ratio.exp() * advantage
    for i, scale in enumerate((1.0, 1.0, 0.25, 0.25)):  # noqa: B007, the surrogate reads it
        assert ("compiled again" in caplog.text) == (i == 3)
        if i == 3:  # weights are shrunk, by new memory
            for p in (p for update in (compiled, eager) for p in update.loss.parameters()):
                p.data = 0.8 * p.data
        rollout = make_rollout(i, torch.float64)
        for update in (compiled, eager):
            update(rollout.clone())
        torch.testing.assert_close(parameters(compiled), parameters(eager), rtol=0, atol=1e-5)
    assert "the update is compiled again: in the loss 'surrogate.scale' went from 1.0 to 0.25" in caplog.text
    assert "compiled again: the memory of a parameter" in caplog.text


def test_a_loss_that_counts_is_not_compiled(caplog):
    update = make_agent(compile="on", epochs=1)
    update.loss.surrogate = Surrogate()
    with pytest.raises(UserError, match="changes a number of its own as it runs.*in the loss 'surrogate.calls' went"):
        update(make_rollout(0))

    update = make_agent(compile="auto", epochs=1)
    update.loss.surrogate = Surrogate()
    update(make_rollout(0))
    assert "runs without, several times slower" in caplog.text
    assert "it changes a number of its own as it runs, which is no part of a graph: in the loss" in caplog.text
    surrogate: Any = update.loss.surrogate
    calls = surrogate.calls
    update(make_rollout(1))
    assert surrogate.calls == calls + 4
    assert "compiled again" not in caplog.text
