from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import distributions
from torchrl.modules import MaskedCategorical

from pgkit import collectors, envs, modules
from pgkit.errors import UserError
from pgkit.modules.discrete import Categorical, MultiCategorical


class Masked(gym.Env):
    """Forbids every other action, each time the other half; an episode ends where a forbidden one is taken."""

    def __init__(self, action_space: spaces.Space | None = None, choices: int = 4) -> None:
        self.action_space, self.n = action_space or spaces.Discrete(4), choices
        self.observation_space = spaces.Dict(
            {"observation": spaces.Box(-1, 1, (3,)), "action_mask": spaces.MultiBinary(choices)}
        )

    def _observe(self) -> dict[str, Any]:
        self.mask = (np.arange(self.n) + self.t) % 2
        return {"observation": np.full(3, 0.1 * self.t, np.float32), "action_mask": self.mask.astype(np.int8)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        starts = np.cumsum([0, *getattr(self.action_space, "nvec", [self.n])[:-1]])
        legal = bool(self.mask[starts + action].all())
        self.t += 1
        return self._observe(), 1.0, not legal, self.t == 16, {}


def test_several_choices_are_a_product():
    # log p(a) = sum of the choices' log-probabilities, H = sum of their entropies; torch's Categorical is the judge
    logits = torch.randn(7, 9, dtype=torch.float64, requires_grad=True)
    parts = [Categorical(logits=x) for x in logits.split([2, 3, 4], -1)]
    dist = MultiCategorical(logits, [2, 3, 4])
    action = torch.stack([part.sample() for part in parts], -1)
    expected = torch.stack([p.log_prob(a) for p, a in zip(parts, action.unbind(-1), strict=True)]).sum(0)
    torch.testing.assert_close(dist.log_prob(action), expected)
    entropy = torch.stack([p.entropy() for p in parts]).sum(0)
    torch.testing.assert_close(dist.entropy(), entropy)
    torch.testing.assert_close(dist.deterministic_sample, torch.stack([p.probs.argmax(-1) for p in parts], -1))
    assert (dist.sample((1000,)).amax((0, 1)) == torch.tensor([1, 2, 3])).all()
    grads = [torch.autograd.grad(x.sum(), logits, retain_graph=True)[0] for x in (dist.entropy(), entropy)]
    torch.testing.assert_close(*grads)


def test_forbidden_actions_have_no_probability_and_no_gradient():
    torch.manual_seed(0)
    env = envs.make(Masked, num_envs=5, seed=1, flatten=False)
    actor = modules.categorical_actor(env, hidden=(8,))
    td = env.reset()
    td["action_mask"][0] = torch.tensor([True, True, False, True])
    dist = actor.get_dist(td)
    forbidden = ~td["action_mask"]
    assert (dist.probs[forbidden] == 0).all() and (dist.probs[~forbidden] > 0).all()
    theirs = MaskedCategorical(logits=dist.logits.detach(), mask=td["action_mask"])
    torch.testing.assert_close(dist.entropy(), theirs.entropy())
    action = theirs.sample()
    torch.testing.assert_close(dist.log_prob(action), theirs.log_prob(action))
    bias = actor.get_parameter("module.0.module.head.head.bias")
    legal, one = td["action_mask"][1:2], actor.get_dist(td[1:2])
    (grad,) = torch.autograd.grad(one.log_prob(legal.float().argmax(-1)).sum() + one.entropy().sum(), bias)
    assert (grad[~legal[0]] == 0).all() and (grad[legal[0]].abs() > 0.1).all() and grad.isfinite().all()


def test_only_legal_actions_are_collected():
    torch.manual_seed(0)
    several = spaces.MultiDiscrete([2, 4])
    for make in (Masked, lambda: Masked(several, 6)):
        env = envs.make(make, num_envs=4, seed=1, flatten=False)
        actor = modules.categorical_actor(env, hidden=(8,))
        for random_frames in (0, 256):
            sizes = {"frames_per_batch": 256, "init_random_frames": random_frames, "compile": "off"}
            rollout = collectors.VectorCollector(env, actor, **sizes).rollout()
            assert not rollout["next", "terminated"].any()
            assert len(rollout["action"].unique()) == 4
        assert rollout["action_mask"].dtype == torch.bool and rollout["observation"].shape == (4, 64, 3)
        assert rollout["next", "truncated"].sum() == 16


def test_a_mask_that_allows_nothing_is_refused():
    class Stuck(Masked):
        def _observe(self) -> dict[str, Any]:
            return super()._observe() | {"action_mask": np.zeros(4, np.int8)}

    env = envs.make(Stuck, num_envs=2, flatten=False)
    collector = collectors.VectorCollector(env, modules.categorical_actor(env), frames_per_batch=8, compile="off")
    with pytest.raises(UserError, match="action_mask allows no action"):
        collector.rollout()


@pytest.mark.parametrize("shape", [(), (7,)])
def test_draws_are_torch_s_numbers(shape):
    logits = torch.randn(5, 3)
    draws = []
    for kind in (Categorical, distributions.Categorical):
        torch.manual_seed(0)
        draws.append(kind(logits=logits.expand(*shape, 5, 3)).sample())
    assert torch.equal(*draws)


def test_several_draws_follow_the_probabilities():
    torch.manual_seed(0)
    probs = torch.tensor([[0.1, 0.2, 0.7], [1.0, 0.0, 0.0]])
    draws = Categorical(probs=probs).sample((20_000,))
    assert draws.shape == (20_000, 2)
    torch.testing.assert_close(torch.nn.functional.one_hot(draws, 3).float().mean(0), probs, rtol=0, atol=0.01)


def test_a_mask_that_is_flattened_is_reported(caplog):
    envs.make(Masked, num_envs=2, flatten=False)
    assert not caplog.text
    envs.make(Masked, num_envs=2)
    assert "action_mask is flattened with the rest and masks nothing" in caplog.text
