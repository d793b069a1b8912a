"""Two learners on gloo, each with half of the rows, against one learner with all of them."""

import copy
import socket
from types import SimpleNamespace

import pytest
import ray
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from tensordict import TensorDict

from pgkit import advantages, collectors, envs, losses, modules, run, updates
from pgkit.compiled import compiled
from pgkit.errors import UserError
from pgkit.functional import standardize
from pgkit.updates import on_policy
from tests.recipes.test_ppo import pgkit, rows

ENVS, STEPS, ROUNDS = 4, 26, 2
CASES = {  # of an update over 52 rows a learner: minibatches of 20, 20 and 12
    "minibatch": dict(recompute_advantage=True, epochs=2),
    "rollout": dict(gae=dict(average_gae=True), normalize=False, masked=True, epochs=2),
    "accumulated": dict(accumulate=2, normalize=False),
    "masked minibatch": dict(masked=True),
    "own": dict(normalize=False, normalize_advantage=True, minibatch_size=None, masked=True),
    "stopped": dict(target_kl=1e-6, epochs=8, lr=0.02),
    "compiled": dict(compile="on", epochs=2),
}


def make(seed=0, gae=None, normalize=True, masked=False, lr=3e-3, **settings):
    """An update in float64; ``masked`` concerns the rollout."""
    torch.manual_seed(seed)
    env = envs.make("Pendulum-v1", num_envs=2)
    actor, critic = modules.gaussian_actor(env, (8,)).double(), modules.state_value(env, (8,)).double()
    loss = losses.ClipPPOLoss(actor, critic, entropy_coeff=0.01, normalize_advantage=normalize).double()
    optimizer = torch.optim.Adam(loss.parameters(), lr=lr)
    settings = {"minibatch_size": 40, "compile": "off", "seed": seed, "epochs": 1} | settings
    return updates.OnPolicyUpdate(loss, advantages.GAE(critic, **(gae or {})).double(), optimizer, **settings)


def make_rollout(seed, masked=False):
    g = torch.Generator().manual_seed(seed)

    def draw(*size):
        return torch.randn(ENVS, STEPS, *size, generator=g, dtype=torch.float64)

    done, observation, final = draw(1) > 1.5, draw(3), draw(3)
    after = torch.where(done, final, torch.cat([observation[:, 1:], final[:, -1:]], 1))
    following = {"observation": after, "reward": draw(1) + 1, "done": done, "terminated": done}
    data = {"observation": observation, "action": draw(1), "action_log_prob": draw() * 0.1 - 1, "next": following}
    if masked:
        mask = draw() > torch.tensor([-1.0, 0.0, 0.5, 1.0]).view(ENVS, 1)  # the learners have different numbers of rows
        data["collector"] = {"mask": mask}
    return TensorDict(data, (ENVS, STEPS))


def outcome(update, normalizer, metrics):
    """What the learners have learned."""
    state = [x.clone() for values in update.optimizer.state.values() for x in values.values()]
    return {
        "parameters": [p.detach().clone() for p in update.loss.parameters()],
        "optimizer": state,
        "normalizer": list(normalizer.state_dict().values()),
        "metrics": metrics,
    }


def learner(rank, port, folder):
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    results = {}
    for name, case in CASES.items():
        update = updates.data_parallel(make(seed=rank, **case))
        normalizer = modules.ObsNormalizer((3,)).double()
        for i in range(ROUNDS):
            share = make_rollout(i, case.get("masked", False)).chunk(2)[rank].clone()
            metrics = update(share)
            normalizer.update(update.learners.gather(share["observation"]))
        assert update._plan is not None
        results[name] = outcome(update, normalizer, metrics)
        results[name]["rungs"] = [native.rung for native in update._plan.native]
    results["errors"] = mistakes(rank)
    torch.save(results, folder / f"{rank}.pt")
    dist.destroy_process_group()


def mistakes(rank):
    found = []
    for trial in (
        lambda: updates.data_parallel(make())(make_rollout(0)[: 1 + rank]),
        lambda: updates.data_parallel(make(minibatch_size=41)),
        lambda: updates.data_parallel(SimpleNamespace()),
    ):
        with pytest.raises(UserError) as caught:
            trial()
        found.append(str(caught.value))
    return found


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """What the two learners have after all cases."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    folder = tmp_path_factory.mktemp("learners")
    mp.spawn(learner, (port, folder), nprocs=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(2)]


def unions(rows, size, generator, device, together):
    """The minibatches of two learners with half of the rows each, as one learner's."""
    order = torch.randperm(rows // 2, generator=generator).split(size // 2)
    parts = [torch.cat([index, rows // 2 + index]) for index in order]
    yield from (tuple(parts[first : first + together]) for first in range(0, len(parts), together))


def one_learner(**case):
    """What one learner learns from the unions, and its last rollout."""
    update, normalizer = make(**case), modules.ObsNormalizer((3,)).double()
    for i in range(ROUNDS):
        rollout = make_rollout(i, case.get("masked", False))
        metrics = update(rollout)
        normalizer.update(rollout["observation"])
    return outcome(update, normalizer, metrics), rollout


@pytest.mark.parametrize("name", CASES)
def test_two_learners_equal_one_with_the_union_of_their_minibatches(name, both, monkeypatch):
    monkeypatch.setattr(on_policy, "minibatches", unions)
    expected, got = one_learner(**CASES[name] | {"compile": "off"})[0], both[0][name]
    for what in ("parameters", "optimizer", "normalizer"):
        for mine, its in zip(got[what], expected[what], strict=True):
            torch.testing.assert_close(mine, its, rtol=0, atol=1e-6)
    for metric in ("loss_objective", "loss_critic", "approx_kl", "grad_norm", "epochs"):
        assert got["metrics"][metric] == pytest.approx(expected["metrics"][metric], rel=1e-6, abs=1e-9), metric


def test_learners_on_ray_equal_one_resume_and_say_that_one_died(monkeypatch):
    collectors.connect(cpus=2)
    try:
        learners = updates.RayLearners(make(epochs=2), 2)
        rollouts = [make_rollout(i) for i in range(ROUNDS)]
        for rollout in rollouts:
            metrics = learners(rollout)
        got = outcome(learners.update, modules.ObsNormalizer((3,)), metrics)
        learners.load_state_dict(learners.state_dict())
        state = copy.deepcopy(learners.state_dict())
        learners(make_rollout(2))
        after = [p.clone() for p in learners.update.loss.parameters()]
        learners.load_state_dict(state)
        learners(make_rollout(2))
        assert all(torch.equal(a, b) for a, b in zip(after, learners.update.loss.parameters(), strict=True))
        assert learners.frames == 3 * ENVS * STEPS
        ray.kill(learners._others[0])
        with pytest.raises(UserError, match="learner 1 is gone"):
            learners(make_rollout(3))
        learners.shutdown()
    finally:
        ray.shutdown()
    monkeypatch.setattr(on_policy, "minibatches", unions)
    expected, rollout = one_learner(epochs=2)
    for what in ("parameters", "optimizer"):
        for mine, its in zip(got[what], expected[what], strict=True):
            torch.testing.assert_close(mine, its, rtol=0, atol=1e-6)
    torch.testing.assert_close(rollouts[-1]["value_target"], rollout["value_target"], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", CASES)
def test_the_replicas_are_equal_bit_for_bit(name, both):
    for what in ("parameters", "optimizer", "normalizer"):
        for first, second in zip(both[0][name][what], both[1][name][what], strict=True):
            assert torch.equal(first, second)
    assert both[0][name]["metrics"] == both[1][name]["metrics"]


def test_they_stop_early_together_and_compile_together(both):
    for result in both:
        assert result["stopped"]["metrics"]["epochs"] < 8
        assert result["compiled"]["rungs"] == ["recorded and compiled"] * 2


def test_mistakes_are_named(both):
    for errors in (result["errors"] for result in both):
        assert errors[0] == "the learners have [26, 52] rows of the rollout: give each the same number of environments"
        assert "minibatch_size=41 cannot be shared by 2 learners" in errors[1]
        assert "takes an OnPolicyUpdate, this is a SimpleNamespace" in errors[2]
    with pytest.raises(UserError, match="needs a process group"):
        updates.data_parallel(make())


def test_a_rung_that_another_learner_cannot_take_is_left():
    votes = iter([False, True])
    native = compiled(
        lambda _, x: [2 * x], {}, lambda _, x: [(None, x + 1)], "record", name="it", agree=lambda ok: next(votes)
    )
    assert torch.equal(native.bind(None, torch.ones(2))(torch.ones(2))[0], torch.full((2,), 2.0))
    assert native.rung == "eager"


def test_standardized_alone_is_standardized(both):
    """One learner of a group of one has the function's own numbers, with a mask and for each agent."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    dist.init_process_group("gloo", init_method=f"tcp://127.0.0.1:{port}", rank=0, world_size=1)
    try:
        learners = updates.data_parallel(make()).learners
        x, mask = torch.randn(4, 5, 3, 1, dtype=torch.float64), torch.rand(4, 5, 3, 1) > 0.3
        torch.testing.assert_close(learners.standardize(x), standardize(x))
        torch.testing.assert_close(learners.standardize(x, mask, [0, 1, 3]), standardize(x, mask, [0, 1, 3]))
    finally:
        dist.destroy_process_group()


def test_ppo_with_two_learners(tmp_path):
    """The recipe's settings count both learners together."""
    flags = ["--env-id", "Pendulum-v1", "--num-envs", 2, "--steps", 64, "--minibatch-size", 64, "--epochs", 2]
    flags += ["--ray", "--learners", 2, "--compile", "off", "--eval-every", 0, "--eval-episodes", 1]
    try:
        pgkit("run", "ppo", *flags, "--total-frames", 256, "--run-dir", tmp_path / "run")
    finally:
        ray.shutdown()
    frames = [(row["frames"], row["train/epochs"]) for row in rows(tmp_path / "run")]
    assert frames == [("128", "2.0"), ("256", "2.0")]
    loaded = run.load_agent(tmp_path / "run")
    assert loaded.normalizer.count == 256  # of all environments
