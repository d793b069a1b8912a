"""What a loss holds besides its parameters, in a compiled step."""

from functools import partial
from typing import Any

import pytest
import torch
from pgkit.constants import Constants
from torch import nn

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


def test_every_place_of_a_number_is_seen(monkeypatch):
    scale = 1.0

    def surrogate(log_ratio, advantage):
        return scale * log_ratio.clamp(max=BOUND) * advantage

    kept = Surrogate()
    for held in (surrogate, partial(surrogate), kept, kept.__call__):
        assert Constants(loss_with(held)).changed() is None
    loss = loss_with(partial(surrogate))
    constants = Constants(loss)
    scale = 0.5
    assert constants.changed() == "'surrogate.scale' went from 1.0 to 0.5"
    constants = Constants(loss)
    monkeypatch.setitem(globals(), "BOUND", 0.2)
    assert constants.changed() == "'surrogate: BOUND' went from 0.1 to 0.2"
    constants = Constants(loss)
    dropout: Any = loss.get_submodule("net.0")
    dropout.p = 0.2
    assert constants.changed() == "'net.0.p' went from 0.1 to 0.2"
    constants = Constants(loss)
    loss.eval()
    assert "training' went from True to False" in str(constants.changed())
    constants = Constants(loss)
    loss.surrogate = surrogate
    assert "'surrogate' went from functools.partial" in str(constants.changed())
    for held in (kept, kept.__call__, partial(surrogate, kept)):
        constants = Constants(loss_with(held))
        kept.power += 1
        assert "power' went from" in str(constants.changed())


class Own(nn.Module):
    """Holds things in many ways."""

    def __init__(self):
        super().__init__()
        self.table, self.row, self.name, self._hidden = {"weight": 1.0}, [1.0, 2.0], "a", 1.0
        self.scale, self.net, self.log = torch.tensor(1.0), nn.Linear(2, 2), []
        self.register_buffer("beta", torch.tensor(1.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda own: own.table.update(weight=2.0), "'table.weight' went from 1.0 to 2.0"),
        (lambda own: own.row.__setitem__(1, 3.0), "'row.1' went from 2.0 to 3.0"),
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
    constants = Constants(own)
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
    assert "compiled again: in the loss 'surrogate.scale' went from 1.0 to 0.25" in caplog.text
    assert "compiled again: in the loss the memory of a parameter" in caplog.text


def test_a_loss_that_counts_is_not_compiled(caplog):
    update = make_agent(compile="on", epochs=1)
    update.loss.surrogate = Surrogate()
    with pytest.raises(UserError, match="changes a number of its own as it runs.*'surrogate.calls' went from"):
        update(make_rollout(0))

    update = make_agent(compile="auto", epochs=1)
    update.loss.surrogate = Surrogate()
    update(make_rollout(0))
    assert "runs without, several times slower (the loss changes a number of its own" in caplog.text
    calls = update.loss.surrogate.calls
    update(make_rollout(1))
    assert update.loss.surrogate.calls == calls + 4
    assert "compiled again" not in caplog.text
