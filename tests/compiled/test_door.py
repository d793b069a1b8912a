"""The door to native code: layouts, staleness, the trial, and the one ladder with its one log line."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from pgkit import envs, modules
from pgkit.collectors.policy import function_of, native_policy
from pgkit.compiled import choose, compiled, door, recorded, undone
from pgkit.compiled.trial import check_repeats
from pgkit.errors import UserError
from pgkit.updates import GradientStep
from pgkit.updates.on_policy import CompiledAdvantage
from pgkit.updates.step import grads_of, metrics_of
from tests.updates.test_on_policy import make_agent, make_rollout


def rows(seed=0, **entries):
    draw = torch.Generator().manual_seed(seed)
    return TensorDict({"x": torch.randn(6, 3, generator=draw), **entries}, [6])


class Net(nn.Module):
    """``scale * (x w)`` of the rows at an index, and a count of the calls in a buffer."""

    def __init__(self, **attributes):
        super().__init__()
        self.w = nn.Parameter(torch.linspace(-1, 1, 3))
        self.register_buffer("count", torch.zeros(1))
        self.scale = 2.0
        for name, value in attributes.items():
            setattr(self, name, value)

    def forward(self, data, index):
        self.count.add_(1)
        x = self.scale * data["x"][index]
        return [x @ self.w.to(x.dtype)]


def shifted(data, index):
    return [(data.apply(lambda x, i=i: x.clone().copy_(x.roll(i, 0))), index.roll(i)) for i in (1, 2)]


def native(function, mode="on", watch=None, others=shifted, **kwargs):
    watch = {"the net": function} if watch is None else watch
    return compiled(function, watch=watch, others=others, mode=mode, name="the test", **kwargs)


INDEX = torch.tensor([4, 1, 0])


def test_compiling_leaves_no_trace_and_calls_write_to_what_is_held():
    net, data = Net(), rows()
    made = native(net)
    random = torch.get_rng_state()
    call = made.bind(data, INDEX)
    assert made.rung == "recorded and compiled" and made.seconds > 0
    assert net.count == 0 and torch.equal(torch.get_rng_state(), random)
    torch.testing.assert_close(call(INDEX)[0], 2 * data["x"][INDEX] @ net.w)
    assert net.count == 1
    with torch.no_grad():
        net.w.mul_(3)
    other = INDEX + 1
    torch.testing.assert_close(call(other)[0], 2 * data["x"][other] @ net.w)


def test_an_entry_that_was_replaced_is_read_at_the_next_bind():
    net, data = Net(), rows()
    made = native(net)
    made.bind(data, INDEX)(INDEX)
    seconds = made.seconds
    data.set("x", rows(1)["x"])
    torch.testing.assert_close(made.bind(data, INDEX)(INDEX)[0], 2 * rows(1)["x"][INDEX] @ net.w)
    assert made.seconds == seconds


@pytest.mark.parametrize(
    "other",
    [
        lambda data: data.double(),
        lambda data: data.apply(lambda x: x.t().contiguous().t()),
        lambda data: TensorDict({"y": data["x"], **data}, [6]),
        lambda data: data.apply(lambda x: torch.randint(-9, 9, x.shape)),
    ],
    ids=["dtype", "strides", "keys", "integers"],
)
def test_data_of_another_layout_gets_code_of_its_own(other):
    net, data = Net(), rows()
    made = native(net)
    for given in (data, other(data), data):
        torch.testing.assert_close(made.bind(given, INDEX)(INDEX)[0], net(given, INDEX)[0])


def test_only_so_many_layouts_are_compiled_for(monkeypatch):
    monkeypatch.setattr(door, "compile_record", lambda graph, _: lambda inputs: graph.forward(*inputs))
    made, built = native(Net()), 0
    for size in range(2, 10):
        index = torch.arange(size) % 6
        seconds = made.seconds
        torch.testing.assert_close(made.bind(rows(), index)(index)[0], made.function(rows(), index)[0])
        built += made.seconds > seconds
    assert built == 4


def test_what_a_module_holds_is_noticed(caplog):
    net, data = Net(), rows()
    made = native(net, "record")
    made.bind(data, INDEX)
    net.scale = 5.0
    torch.testing.assert_close(made.bind(data, INDEX)(INDEX)[0], 5 * data["x"][INDEX] @ net.w)
    assert "the test is compiled again: in the net 'scale' went from 2.0 to 5.0" in caplog.text


def test_what_a_module_holds_is_noticed_after_a_layout_that_nothing_bears(monkeypatch):
    net, data = Net(), rows()
    made = native(net, "record")
    made.bind(data, INDEX)
    with monkeypatch.context() as patch:
        patch.setattr(recorded, "record", None)
        made.bind(data, INDEX[:2])
        assert made.rung == "eager"
    net.scale = 5.0
    torch.testing.assert_close(made.bind(data, INDEX)(INDEX)[0], 5 * data["x"][INDEX] @ net.w)


def moved(name, error):
    def raises(*_, **__):
        raise error

    return lambda patch: patch.setattr(*{"recording": (recorded, "record"), "inductor": (door, "compile_record"),
                                         "dynamo": (door, "torch_compiled")}[name], raises)  # fmt: skip


ERRORS = [kind("it has moved") for kind in (ImportError, AttributeError, TypeError, RuntimeError)]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize(
    ("broken", "rung", "failed"),
    [
        ((), "recorded and compiled", 0),
        (("inductor",), "torch.compile", 1),
        (("recording",), "torch.compile", 1),
        (("inductor", "dynamo"), "recorded, not compiled", 2),
        (("recording", "dynamo"), "eager", 3),
    ],
)
def test_the_ladder(broken, rung, failed, error, monkeypatch, caplog):
    if not broken and error is not ERRORS[0]:
        return
    caplog.set_level("INFO", "pgkit")
    for name in broken:
        moved(name, error)(monkeypatch)
    net, data = Net(), rows()
    made = native(net, "auto")
    torch.testing.assert_close(made.bind(data, INDEX)(INDEX)[0], 2 * data["x"][INDEX] @ net.w)
    assert made.rung == rung and net.count == 1
    (line,) = [record for record in caplog.records if "once" not in record.message]
    assert (line.levelname == "WARNING") == (rung in ("recorded, not compiled", "eager"))
    assert line.message.count(str(error)) == failed
    assert (rung in line.message) == (rung != "eager")
    if set(broken) >= {"dynamo"}:
        with pytest.raises(UserError, match=f"the test cannot be compiled .*{error}.*compile='auto' runs it without"):
            native(net, "on").bind(data, INDEX)


@pytest.mark.parametrize("mode", ["record", "off"])
def test_modes_without_a_compiler_give_the_same_bits(mode):
    net, data = Net(), rows()
    made = native(net, mode)
    assert torch.equal(made.bind(data, INDEX)(INDEX)[0], net(data, INDEX)[0])
    assert made.rung == ("eager" if mode == "off" else "recorded, not compiled")


def test_errors_of_the_function_are_its_own(caplog):
    class Wrong(Net):
        def forward(self, data, index):
            raise RuntimeError("a proxy of the tracks is retracted")

    call = native(Wrong(), "auto").bind(rows(), INDEX)
    with pytest.raises(RuntimeError, match="tracks is retracted"):
        call(INDEX)

    class Mistaken(Net):
        def forward(self, data, index):
            raise UserError("give it another one")

    with pytest.raises(UserError, match="give it another one"):
        native(Mistaken(), "auto").bind(rows(), INDEX)


@pytest.mark.parametrize("entry", ["pixels", "mask", "number"])
def test_a_record_must_repeat_the_function_on_integers_masks_and_images(entry):
    """What is computed outside torch is a constant of the record; the rows that it was recorded with agree."""
    entries = {
        "pixels": torch.randint(255, (6, 2, 2), dtype=torch.uint8),
        "mask": torch.tensor([True, False, True, True, False, False]),
        "number": torch.arange(6),
    }

    class Outside(Net):
        def forward(self, data, index):
            return [data["x"][index] * float(data[entry][index].numpy().sum())]

    net, data = Outside(), rows(**{entry: entries[entry]})
    made = native(net, "record")
    assert torch.equal(made.bind(data, INDEX)(INDEX)[0], net(data, INDEX)[0])
    assert made.rung == "eager"


def test_a_write_that_gets_lost_is_found():
    """Compiled graphs lose some writes to a float64 scalar."""
    net = Net()

    def loses(data, index):
        return [x.clone() for x in undone([net.count], lambda: net(data, index))]

    check_repeats(net, net, [net.count], [(rows(), INDEX)])
    with pytest.raises(RuntimeError, match=r"loses what the function writes to a tensor of shape \(1,\)"):
        check_repeats(loses, net, [net.count], [(rows(), INDEX)])


def test_choice():
    assert choose("on", 1, 10) == "on" and choose("off", None, 10) == "off"
    assert choose("auto", 9, 10) == "off" and choose("auto", None, 10) == choose("auto", 10, 10) == "auto"
    with pytest.raises(UserError, match="compile is 'auto', 'on' or 'off', not 'yes'"):
        choose("yes", None, 10)


def step_of(mode):
    update = make_agent(compile=mode, epochs=1)
    metrics = update(make_rollout())
    assert update._plan is not None
    return update._plan.native[0], metrics["loss_objective"]


def block_of(mode):
    update = make_agent(compile=mode, epochs=1, minibatch_size=None)
    block = CompiledAdvantage(update.advantage, mode)
    return block.native, float(block(make_rollout())["advantage"].sum())


def policy_of(mode):
    torch.manual_seed(0)
    env = envs.make("Pendulum-v1", 2)
    actor, obs = modules.gaussian_actor(env), torch.ones(2, 3)
    native = native_policy(function_of(actor, ["observation"]), [obs], actor, "record" if mode == "off" else mode)
    torch.manual_seed(1)
    return native, float(native.bind(None, obs)(obs)[0].sum())


@pytest.mark.parametrize("client", [step_of, block_of, policy_of])
def test_step_block_and_policy_fail_alike(client, monkeypatch, caplog):
    moved("inductor", TypeError("it has moved"))(monkeypatch)
    moved("dynamo", AttributeError("it has moved"))(monkeypatch)
    _, expected = client("off")
    native, got = client("auto")
    assert native.rung == "recorded, not compiled" and got == pytest.approx(expected)
    assert "runs recorded, not compiled (recorded and compiled: it has moved" in caplog.text
    with pytest.raises(UserError, match="cannot be compiled .*it has moved.*compile='auto' runs it without"):
        client("on")


def test_the_public_step_reads_what_its_data_holds_now():
    """Also an entry that was replaced in the same TensorDict."""
    rollout, results = make_rollout().reshape(-1), []
    for mode in ("off", "record"):
        agent = make_agent()
        assert agent.advantage is not None
        data, optimizer = agent.advantage(rollout.clone()), agent.optimizer
        params = optimizer.param_groups[0]["params"]

        def gradients(data, index, loss=agent.loss, params=params):
            out = loss(data[index])
            grads = grads_of(out, params)
            return metrics_of(out, ["loss_objective"], grads[0]), grads

        step = GradientStep(gradients, optimizer, ["loss_objective"], watch={"the loss": agent.loss}, mode=mode)
        index = torch.arange(16)
        step(data, index)
        data.set("advantage", -3 * data["advantage"] + 1)
        results.append(step(data, index))
    torch.testing.assert_close(*results, rtol=1e-5, atol=1e-6)
