"""Properties of losses and updates: order of rows, padding, types, accumulation, save and load."""

import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from pgkit import advantages, collectors, data, envs, files, losses, modules, updates
from pgkit.data.sum_tree import SumTree
from pgkit.updates.minibatches import minibatches

OPTIMIZERS = st.sampled_from([torch.optim.Adam, torch.optim.SGD])
SEEDS = st.integers(0, 2**31)
POLICY_LOSSES = st.sampled_from(["ClipPPOLoss", "A2CLoss", "ReinforceLoss", "KLPENPPOLoss", "TRPOLoss"])


@cache
def pendulum() -> Any:
    return envs.make("Pendulum-v1", num_envs=2)


def made(name: str, dtype: torch.dtype = torch.float64) -> Any:
    """A loss, and its networks."""
    torch.manual_seed(0)
    actor, critic = modules.gaussian_actor(pendulum(), (6,)), modules.state_value(pendulum(), (6,))
    actor, critic = actor.to(dtype), critic.to(dtype)
    loss = getattr(losses, name)(actor, critic)
    loss.normalize_advantage = False  # by the deviation of n - 1 rows, it counts them
    return loss, [*actor.parameters(), *critic.parameters()], critic


def batch_of(loss: Any, rows: int, seed: int, dtype: torch.dtype = torch.float64) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(rows, *shape, generator=generator, dtype=torch.float64).to(dtype)

    batch = TensorDict(
        {"observation": draw(3), "action": draw(1), "advantage": draw(1), "value_target": draw(1)}, [rows]
    )
    batch["action_log_prob"], batch["state_value"] = draw() - 1, draw(1)
    return loss.keep_distribution(batch)


def gradients(loss: Any, params: Any, batch: TensorDict) -> list[torch.Tensor]:
    out = loss(batch)
    total = sum(out[key] for key in out.keys() if key.startswith("loss"))
    return [total.detach(), *torch.autograd.grad(total, params, allow_unused=True, materialize_grads=True)]


def close(one: list[torch.Tensor], other: list[torch.Tensor], tolerance: float = 1e-9) -> None:
    for x, y in zip(one, other, strict=True):
        torch.testing.assert_close(x.double(), y.double(), rtol=tolerance, atol=tolerance)


@settings(max_examples=30)
@given(POLICY_LOSSES, st.integers(2, 9), SEEDS)
def test_rows_have_no_order_and_padding_does_not_count(name: str, rows: int, seed: int):
    loss, params, _ = made(name)
    batch = batch_of(loss, rows, seed)
    before, expected = batch.clone(), gradients(loss, params, batch.clone())
    loss(batch)
    assert (batch.select(*before.keys()) == before).all()  # it is left as it was
    order = torch.randperm(rows, generator=torch.Generator().manual_seed(seed))
    close(gradients(loss, params, batch[order]), expected)
    close(gradients(loss, params, torch.cat([batch, batch])), expected)
    padded = torch.cat([batch, batch_of(loss, 3, seed + 1)])
    padded["advantage"][rows:] = padded["value_target"][rows:] = float("nan")
    padded["collector", "mask"] = torch.arange(rows + 3) < rows
    masked, params, _ = made(name)
    close(gradients(masked, params, padded), expected)


@settings(max_examples=15)
@given(POLICY_LOSSES, st.integers(1, 9), SEEDS)
def test_single_precision_agrees_with_double(name: str, rows: int, seed: int):
    double, single = made(name), made(name, torch.float32)
    expected = gradients(*double[:2], batch_of(double[0], rows, seed))
    close(gradients(*single[:2], batch_of(single[0], rows, seed, torch.float32)), expected, 2e-3)


@given(st.integers(1, 50), st.integers(1, 60), st.integers(1, 5), SEEDS)
def test_an_epoch_has_every_row_once(rows: int, size: int, together: int, seed: int):
    steps = list(minibatches(rows, size, torch.Generator().manual_seed(seed), torch.device("cpu"), together))
    parts = [part for step in steps for part in step]
    assert torch.cat(parts).sort().values.tolist() == list(range(rows))
    assert all(len(part) == size for part in parts[:-1]) and all(len(step) <= together for step in steps)


@cache
def rollout() -> TensorDict:
    torch.manual_seed(0)
    actor = modules.gaussian_actor(pendulum(), (6,))
    return collectors.VectorCollector(pendulum(), actor, frames_per_batch=24, compile="off").rollout()


def update_of(size: int | None, accumulate: int, epochs: int, optimizer: Any = torch.optim.SGD) -> Any:
    loss, params, critic = made("ClipPPOLoss", torch.float32)
    advantage = advantages.GAE(critic, gamma=0.9)
    return updates.OnPolicyUpdate(
        loss, advantage, optimizer(params, 1e-2), epochs=epochs, minibatch_size=size, accumulate=accumulate,
        compile="off", seed=0,
    ), params  # fmt: skip


@settings(max_examples=8)
@given(st.sampled_from([2, 3, 4, 6, 8, 12, 24]), st.integers(1, 2))
def test_accumulated_minibatches_are_one_large_one(size: int, epochs: int):
    for parts in (x for x in (1, 2, 3, 4) if 24 % (size * x) == 0):
        (small, one), (large, other) = update_of(size, parts, epochs), update_of(size * parts, 1, epochs)
        small(rollout().clone())
        large(rollout().clone())
        close([x.detach() for x in one], [x.detach() for x in other], 1e-5)


@settings(max_examples=8)
@given(
    st.integers(0, 2),
    st.integers(1, 2),
    st.sampled_from([5, 8, 24]),
    st.sampled_from([torch.optim.Adam, torch.optim.SGD]),
)
def test_an_update_goes_on_from_its_saved_state(before: int, after: int, size: int, optimizer: Any):
    (whole, weights), (first, _), (second, again) = (update_of(size, 1, 2, optimizer) for _ in range(3))
    for _ in range(before + after):
        whole(rollout().clone())
    for _ in range(before):
        first(rollout().clone())
    with tempfile.TemporaryDirectory() as folder:
        files.save(Path(folder) / "x", first.state_dict())
        second.load_state_dict(files.load(Path(folder) / "x"))
    for _ in range(after):
        second(rollout().clone())
    assert all(map(torch.equal, weights, again))


leaves = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**60), 2**60), st.floats(allow_nan=False), st.text(max_size=9),
    st.binary(max_size=9), SEEDS.map(lambda seed: torch.randn(2, 3, generator=torch.Generator().manual_seed(seed))),
    SEEDS.map(lambda seed: torch.arange(seed % 5).numpy()),
)  # fmt: skip
inner = leaves | st.lists(leaves, max_size=3) | st.dictionaries(st.text(max_size=5), leaves, max_size=3)
contents = (
    st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3) | st.tuples(inner, inner)
)


def equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(x, other[key]) for key, x in one.items())
    if isinstance(one, list | tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(equal, one, other))
    if hasattr(one, "dtype"):
        return type(one) is type(other) and one.dtype == other.dtype and one.tolist() == other.tolist()
    return type(one) is type(other) and one == other


@given(contents)
def test_files_come_back_as_they_were(content: Any):
    with tempfile.TemporaryDirectory() as folder:
        files.save(Path(folder) / "x", content)
        assert equal(content, files.load(Path(folder) / "x"))


@settings(max_examples=25)
@given(st.integers(2, 30), st.lists(st.integers(1, 9), min_size=1, max_size=8), st.integers(1, 3))
def test_a_replay_holds_the_last_frames_and_comes_back(capacity: int, lengths: list[int], n_steps: int):
    env = pendulum()
    buffer, again = (data.ReplayBuffer(env, 2 * capacity, n_steps=n_steps, seed=3) for _ in range(2))
    count = 0
    for steps in lengths:  # frame k of environment n observes (k, n)
        k = torch.arange(count, count + steps).float()
        now = torch.stack([k.expand(2, -1), torch.tensor([[0.0], [1.0]]).expand(2, steps), k.expand(2, -1)], -1)
        end = torch.zeros(2, steps, 1, dtype=torch.bool)
        after = {
            "observation": now + torch.tensor([1.0, 0.0, 1.0]),
            "reward": now[..., :1],
            "terminated": end,
            "done": end,
        }
        buffer.extend(TensorDict({"observation": now, "action": now[..., :1], "next": after}, [2, steps]))
        count += steps
    ready = max(min(count, capacity) - (n_steps - 1), 0)
    assert len(buffer) <= 2 * count and len(buffer) >= 2 * min(ready, capacity - n_steps)
    if len(buffer):
        again.load_state_dict(buffer.state_dict())
        for batch in (x.sample(min(64, len(buffer)), 0.5) for x in (buffer, again)):
            first = batch["observation"][:, 0]
            assert first.min() >= count - capacity - 1 and first.max() < count - (n_steps - 1)
            torch.testing.assert_close(batch["next", "observation"][:, 0], first + n_steps)
            reward = sum(0.5**i * (first + i) for i in range(n_steps))
            torch.testing.assert_close(batch["next", "reward"][:, 0], reward)


@given(st.lists(st.tuples(st.integers(0, 199), st.floats(0, 100)), min_size=1, max_size=60), st.floats(0, 0.999))
def test_a_sum_tree_finds_what_a_running_sum_finds(writes: list[tuple[int, float]], share: float):
    tree, plain = SumTree(200), torch.zeros(200, dtype=torch.float64)
    for index, value in writes:
        tree.set(torch.tensor([index]), value)
        plain[index] = value
    torch.testing.assert_close(tree.sums.sum(), plain.sum())
    if plain.sum() > 0:
        found = int(tree.find(torch.tensor([share]))[0])
        sums, mass = plain.cumsum(0), share * float(plain.sum())
        slack = 1e-9 * float(plain.sum())
        assert plain[found] > 0 and sums[found] >= mass - slack and (found == 0 or sums[found - 1] <= mass + slack)
