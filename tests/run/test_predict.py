"""``policy.predict``: the same actions as in training, one row or many, with a memory or without."""

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from pgkit import envs, modules, run
from pgkit.errors import UserError
from pgkit.run.evaluate import RECORDED_AT


def policy(memory: bool = False, **kwargs: Any) -> run.Policy:
    torch.manual_seed(0)
    env = envs.make("pgkit/TMaze-v0" if memory else "Pendulum-v1", num_envs=4)
    if memory:
        return run.Policy.of(modules.categorical_actor(env, encoder=modules.gru(env, 8)), env)
    return run.Policy.of(modules.gaussian_actor(env, (8,), normalizer=modules.ObsNormalizer(env), **kwargs), env)


@pytest.mark.fault(
    kind=10,
    injected="20 calls and more of `predict`, after which it is recorded; new weights, attributes and modes then",
    outcome="the same actions bit for bit, and every change takes effect",
)
def test_predict_is_the_actor_bit_for_bit_recorded_or_not():
    one, draw = policy(), np.random.default_rng(0)
    actor: Any = one.actor
    for call in range(3 * RECORDED_AT):
        if call == 2 * RECORDED_AT:
            with torch.no_grad():
                actor.get_submodule("module.0.module")[-1].mean.bias.fill_(0.25)
        obs = draw.normal(size=(4, 3)).astype("f4")
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            expected = actor(TensorDict({"observation": torch.from_numpy(obs)}, [4]))["action"]
        np.testing.assert_array_equal(one.predict(obs), expected.clamp(-2, 2).numpy())
        np.testing.assert_array_equal(one.predict(obs[0]).shape, (1,))
    assert len(one._acting._recorded) == 2
    torch.manual_seed(3)
    drawn = [one.predict(obs, deterministic=False) for _ in range(30)]
    torch.manual_seed(3)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        for got in drawn:
            again = actor(TensorDict({"observation": torch.from_numpy(obs)}, [4]))["action"]
            np.testing.assert_array_equal(got, again.clamp(-2, 2).numpy())


class Scaled(nn.Module):
    scale = 1.0

    def __init__(self) -> None:
        super().__init__()
        self.linear, self.scale = nn.Linear(3, 8), 1.0

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return nn.functional.dropout(self.linear(x), 0.5, self.training) * self.scale


def test_attributes_that_change_are_noticed_and_modes_do_not_matter():
    torch.manual_seed(0)
    env, body = envs.make("Pendulum-v1"), Scaled()
    one = run.Policy.of(modules.gaussian_actor(env, encoder=body), env)
    obs = np.ones(3, "f4")
    first = [one.predict(obs) for _ in range(50)]
    assert all((x == first[0]).all() for x in first) and body.training
    body.scale = 0.0
    assert one.predict(obs) != first[0] and len(one._acting._recorded) == 0
    zero = [one.predict(obs) for _ in range(50)]
    assert all((x == zero[0]).all() for x in zero) and len(one._acting._recorded) == 1


@pytest.mark.fault(
    kind=10,
    injected="a recurrent policy: rows that begin an episode amid others, other numbers of rows",
    outcome="`episode_start=` empties the memory of those rows; rows that change without it are refused in one line",
)
def test_a_memory_and_which_rows_begin_an_episode():
    one, fresh = policy(memory=True), policy(memory=True)
    obs = np.random.default_rng(0).normal(size=(40, 4, *one.shapes["observation"])).astype("f4")
    starts = np.random.default_rng(1).random((40, 4)) < 0.2
    states: list[Any] = []
    for x, start in zip(obs, starts, strict=True):
        one.predict(x, episode_start=start)
        states.append(one._acting.state)
    for row in range(4):  # each row by itself, reset where its episode begins
        fresh.reset()
        for t in range(40):
            if starts[t, row]:
                fresh.reset()
            fresh.predict(obs[t, row])
            state: Any = fresh._acting.state
            torch.testing.assert_close(state[0], states[t][row])
    with pytest.raises(UserError, match=r"predict got 2 observations after 1.*call reset\(\), or give episode_start="):
        fresh.predict(obs[0, :2])
    with pytest.raises(UserError, match="predict got 3 flags of episode_start for 2 observations: one"):
        fresh.predict(obs[0, :2], episode_start=[True] * 3)
    assert fresh.predict(obs[0, :2], episode_start=[True, True]).shape == (2,)
    assert fresh.predict(obs[0, :2]).shape == (2,)
    fresh.reset()
    assert fresh.predict(obs[0, :3]).shape == (3,)
