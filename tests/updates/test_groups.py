"""Groups of agents end to end: memories, masks that allow nothing, A2C, SAC and TD3, two updates in one loop."""

from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from pgkit import advantages, collectors, envs, losses, modules, run, updates
from pgkit.errors import UserError
from pgkit.run.policy import Policy
from tests.envs.test_agents import Fading, Unlike


def collector(env: Any, actor: Any, frames: int = 64, **settings: Any) -> Any:
    return collectors.VectorCollector(env, actor, frames_per_batch=frames, compile="off", **settings)


@pytest.mark.parametrize(("core", "share"), [(modules.gru, True), (modules.lstm, False)])
def test_agents_with_memories_are_trained_on_what_they_remembered(core: Any, share: bool):
    torch.manual_seed(0)
    env = envs.make(Fading, num_envs=4, seed=1, dies=3, limit=5)
    memory = core(env, 8, (8,), share_parameters=share)
    actor, critic = modules.gaussian_actor(env, encoder=memory), modules.state_value(env, encoder=memory)
    with torch.no_grad():
        actor.get_submodule("module.0.module.head.mean").weight.mul_(300)  # so that a wrong memory shows
    loss = losses.ClipPPOLoss(actor, critic)
    update = updates.OnPolicyUpdate(
        loss, advantages.GAE(critic), torch.optim.SGD(loss.parameters(), lr=0.0), epochs=1, minibatch_size=32,
        sequence_length=8, compile="off", seed=0,
    )  # fmt: skip
    collect = collector(env, actor)
    collect.rollout()  # 16 steps: an episode of 5 is under way where the next one begins
    rollout = collect.rollout()
    state = rollout["agents", "recurrent_state"]
    assert state.shape == (4, 16, 2, memory.state_size) and not rollout["is_init"][:, 0].any()
    carried = ~rollout["next", "done"][:, :-1, 0]
    assert torch.equal(state[:, 1:][carried], rollout["next", "agents", "recurrent_state"][:, :-1][carried])
    wrong = rollout.clone()
    metrics = update(rollout)
    assert metrics["approx_kl"] == pytest.approx(0, abs=1e-9) and metrics["clip_fraction"] == 0
    wrong["agents", "recurrent_state"].zero_()
    assert update(wrong)["approx_kl"] > 1e-4
    returns, lengths = run.play(actor, env, episodes=4)
    assert lengths.tolist() == [5] * 4 and np.isfinite(returns).all()


class Forbidden(Unlike):
    """At its second step the speaker, who is still there, may choose nothing."""

    def _observe(self) -> dict[str, Any]:
        seen = super()._observe()
        if self.t == 1:
            seen["speaker_0"]["action_mask"] = np.zeros(3, np.int8)
        return seen

    def step(self, actions: dict[str, Any]) -> Any:
        return super().step(actions | ({"speaker_0": 0} if "speaker_0" in actions else {}))


def test_a_mask_that_allows_nothing_is_an_error():
    env = envs.make(Forbidden, num_envs=2, seed=1)
    actors = modules.categorical_actor(env, (8,), group="speaker"), modules.gaussian_actor(env, (8,), group="listener")
    with pytest.raises(UserError, match="action_mask allows no action in some state: it must allow at least one"):
        collector(env, TensorDictSequential(*actors)).rollout()


def test_a2c_trains_a_group():
    torch.manual_seed(0)
    env = envs.make(Fading, num_envs=8, seed=1)
    actor, critic = modules.gaussian_actor(env, (16,)), modules.state_value(env, (16,), centralized=True)
    loss = losses.A2CLoss(actor, critic, entropy_coeff=0.0)
    update = updates.OnPolicyUpdate(
        loss, advantages.GAE(critic), torch.optim.Adam(loss.parameters(), lr=2e-2), compile="off"
    )
    assert improves(env, actor, update, frames=128, rollouts=40) > 0.4


def off_policy(kind: str, env: Any) -> tuple[Any, Any]:
    torch.manual_seed(0)
    critic = modules.q_value(env, hidden=(32,))
    if kind == "sac":
        actor = explored = modules.tanh_normal_actor(env, (32,))
        loss = losses.SACLoss(actor, critic, alpha_init=0.01, gamma=0.5)
    else:
        actor = modules.deterministic_actor(env, (32,))
        explored = modules.GaussianExploration(actor, env, std=0.3)
        loss = losses.TD3Loss(actor, critic, bounds=(-1.0, 1.0), gamma=0.5)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(4_000), batch_size=64)  # pgkit's own has no groups
    update = updates.OffPolicyUpdate(
        loss, buffer, torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], lr=3e-3), batch_size=64,
        updates_per_step=0.5, learning_starts=64, compile="off",
    )  # fmt: skip
    return explored, update


@pytest.mark.parametrize("kind", ["sac", "td3"])
def test_off_policy_methods_train_a_group(kind: str):
    env = envs.make(Fading, num_envs=8, seed=1, dies=99)
    explored, update = off_policy(kind, env)
    assert improves(env, explored, update, frames=64, rollouts=15) > 0.4


def improves(env: Any, actor: Any, update: Any, frames: int, rollouts: int) -> float:
    """How much more agents are paid for a step (their action, at most 1) in the last rollout than in the first."""
    collect, paid = collector(env, actor, frames), []
    for _ in range(rollouts):
        rollout = collect.rollout()
        paid.append(rollout["next", "agents", "reward"][rollout["agents", "mask"]].mean().item())
        assert all(np.isfinite(x) for x in update(rollout).values())
    return paid[-1] - paid[0]


def test_two_groups_in_one_loop_are_trained_by_an_update_each():
    torch.manual_seed(0)
    env = envs.make(Unlike, num_envs=4, seed=1)
    made = {"speaker": modules.categorical_actor(env, (8,), group="speaker")}
    made["listener"] = modules.gaussian_actor(env, (8,), group="listener")
    learners = {}
    for group, actor in made.items():
        critic = modules.state_value(env, (8,), group=group)
        loss = losses.ClipPPOLoss(actor, critic)
        learners[group] = updates.OnPolicyUpdate(
            loss, advantages.GAE(critic), torch.optim.Adam(loss.parameters()), epochs=1, compile="off"
        )
    keys = [(group, name) for group in made for name in ("action", "action_log_prob")]
    rollout = collector(env, TensorDictSequential(*made.values(), selected_out_keys=keys)).rollout()
    before = {group: [p.clone() for p in actor.parameters()] for group, actor in made.items()}
    learners["listener"](rollout)
    moved = {
        g: any((a != b).any() for a, b in zip(actor.parameters(), before[g], strict=True)) for g, actor in made.items()
    }
    assert moved == {"speaker": False, "listener": True}
    learners["speaker"](rollout)
    assert rollout["speaker", "advantage"].shape == rollout["listener", "advantage"].shape == (4, 16, 1, 1)


def test_a_policy_of_groups_predicts_on_plain_arrays():
    torch.manual_seed(0)
    env = envs.make(Fading, num_envs=2, seed=1)
    team = Policy.of(modules.gaussian_actor(env, (8,), log_std=-9.0), env)
    one, many = np.array([[0.5, 0.0], [0.5, 1.0]], np.float32), np.zeros((3, 2, 2), np.float32)
    assert team.predict(one).shape == (2, 1) and team.predict(many).shape == (3, 2, 1)
    np.testing.assert_array_equal(team.predict({"agents": one}), team.predict(one))
    np.testing.assert_array_equal(team.predict({("agents", "observation"): one}), team.predict(one))
    assert np.abs(team.predict(1e6 * many + 1e6)).max() <= 1

    env = envs.make(Unlike, num_envs=2, seed=1)
    actors = modules.categorical_actor(env, (8,), group="speaker"), modules.gaussian_actor(env, (8,), group="listener")
    with torch.no_grad():
        for name, weight in actors[1].named_parameters():
            weight.mul_(1e4 if "mean" in name else 1)
    both = Policy.of(TensorDictSequential(*actors), env)
    given: Any = {"speaker": {"observation": one[:1], "action_mask": [[False, False, True]]}, "listener": one[1:]}
    made = both.predict(given)
    assert made["speaker"].tolist() == [2] and made["listener"].shape == (1, 1) and np.abs(made["listener"]).max() == 1
    with pytest.raises(UserError, match=r"predict got speaker.observation; the policy takes the entries"):
        both.predict({"speaker": one[:1]})
    with pytest.raises(UserError, match=r"shape \[4, 2\]; the policy takes \[2, 2\] or a batch"):
        team.predict(np.zeros((4, 2)))
