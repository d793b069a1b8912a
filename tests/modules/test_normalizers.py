import pytest
import torch
from tensordict import TensorDict

from pgkit import envs, modules
from pgkit.errors import UserError
from tests.modules.test_groups import Team
from tests.modules.test_groups import batch as observations


def test_moments_equal_those_of_all_batches():
    torch.manual_seed(0)
    batches = [torch.randn(n, 3) * 5 + 2 for n in (7, 50, 301)]
    normalizer = modules.ObsNormalizer((3,))
    for batch in batches:
        normalizer.update(batch)
    everything = torch.cat(batches)
    torch.testing.assert_close(normalizer.mean, everything.mean(0))
    torch.testing.assert_close(normalizer.var, everything.var(0, correction=0))
    assert normalizer.count == len(everything)
    out = normalizer(everything)
    torch.testing.assert_close(out.mean(0), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(out.std(0, correction=0), torch.ones(3), atol=1e-5, rtol=0)


def test_identity_at_first_and_clipped():
    normalizer = modules.ObsNormalizer((1,), clip=10.0)
    x = torch.tensor([[3.0], [50.0]])
    torch.testing.assert_close(normalizer(x), torch.tensor([[3.0], [10.0]]))


def test_changes_only_by_update_and_travels_with_the_policy():
    env = envs.make("Pendulum-v1", num_envs=2)
    normalizer = modules.ObsNormalizer(env)
    actor = modules.gaussian_actor(env, normalizer=normalizer)
    before = {key: value.clone() for key, value in actor.state_dict().items()}
    actor.train()
    actor(env.reset())
    assert all(torch.equal(before[key], value) for key, value in actor.state_dict().items())
    normalizer.update(torch.randn(100, 3) + 4)
    copy = modules.gaussian_actor(env, normalizer=modules.ObsNormalizer(env))
    copy.load_state_dict(actor.state_dict())
    obs = env.reset()
    params = actor.get_dist(obs.copy()), copy.get_dist(obs.copy())
    assert torch.equal(params[0].base_dist.loc, params[1].base_dist.loc)
    assert not torch.equal(before["module.0.module.0.mean"], copy.state_dict()["module.0.module.0.mean"])


def test_return_scale_leaves_the_critic_s_values_in_the_rewards_unit():
    # V = 2 x + 1 in units of the scale 1; after targets 0 and 8 (deviation 4): (2 x + 1) / 4 in units of 4
    scale, critic = modules.ReturnScale(), torch.nn.Sequential(torch.nn.Linear(1, 1), torch.nn.Linear(1, 1))
    for parameter, value in zip(critic.parameters(), (1.0, 0.0, 2.0, 1.0), strict=True):
        parameter.data.fill_(value)
    scale.update(torch.tensor([0.0, 8.0]), critic)
    assert scale.scale.item() == pytest.approx(4.0)
    assert critic(torch.tensor([[3.0]])).item() * 4 == pytest.approx(7.0)


def test_return_scale_does_not_feed_itself():
    # short rollouts: targets are 0.9 of the critic's own values, which learns slowly (here: not); V = 2 x at first
    def run(rescale):
        torch.manual_seed(0)
        scale, critic = modules.ReturnScale(), torch.nn.Linear(1, 1)
        critic.weight.data.fill_(2.0)
        for _ in range(300):
            scale.update(0.9 * critic(torch.randn(64, 1)).detach(), critic if rescale else None)
        return scale.scale.item()

    assert run(True) == pytest.approx(1.8, rel=0.1)
    assert run(False) > 50


def test_whole_numbers_are_taken_in():
    normalizer = modules.ObsNormalizer((2,))
    normalizer.update(torch.tensor([[0, 10], [4, 10]], dtype=torch.uint8))
    torch.testing.assert_close(normalizer.mean, torch.tensor([2.0, 10.0]))


@pytest.mark.fault(
    kind=3,
    injected="one observation of ±1e6, 1e38 or infinity, in the first rollout or later",
    outcome="mean and deviation stay within 5% of those without it",
)
@pytest.mark.parametrize("rollout", [0, 1, 20])
@pytest.mark.parametrize("outlier", [1e6, -1e6, float("inf"), 1e38])
def test_one_outlier_does_not_blind(rollout, outlier):
    # eight environments, 256 steps, one number of 300,000 is off; its own entry must keep its scale for all others
    torch.manual_seed(0)
    normalizer, clean = modules.ObsNormalizer((3,)), modules.ObsNormalizer((3,))
    for i in range(21):
        x = torch.randn(8, 256, 3) * torch.tensor([1.0, 0.01, 50.0]) + torch.tensor([0.0, 7.0, -3.0])
        clean.update(x)
        x[4, 100, 1] = outlier if i == rollout else x[4, 100, 1]
        normalizer.update(x)
        ratio = (normalizer.spread / clean.spread).sqrt()
        assert ratio.min() > 0.99 and ratio.max() < 1.05
        assert ((normalizer.mean - clean.mean) / clean.spread.sqrt()).abs().max() < 0.01
    assert torch.equal(normalizer.spread[[0, 2]], clean.spread[[0, 2]])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("samples", [1, 8, 64])
def test_small_first_batches_find_the_scale(scale, samples):
    torch.manual_seed(0)
    normalizer = modules.ObsNormalizer((1,))
    for _ in range(4000 // samples):
        normalizer.update(scale * (torch.randn(samples, 1) + 3))
    assert normalizer.spread.sqrt().item() == pytest.approx(scale, rel=0.1)
    assert normalizer.mean.item() == pytest.approx(3 * scale, rel=0.1)


def test_a_scale_that_grows_is_followed():
    # a policy that learns to run: after 10 rollouts at speed 0 +- 1, 200 rollouts at 40 +- 1
    torch.manual_seed(0)
    normalizer, seen = modules.ObsNormalizer((1,)), []
    for i in range(210):
        seen.append(torch.randn(256, 1) + 40 * (i >= 10))
        normalizer.update(seen[-1])
    everything = torch.cat(seen)
    assert normalizer.mean.item() == pytest.approx(everything.mean().item(), rel=0.1)
    assert normalizer.spread.sqrt().item() == pytest.approx(everything.std().item(), rel=0.3)


def contact(share, size, samples=2048):
    """Zero but for a share of spikes, as a contact force."""
    return size * torch.randn(samples, 1).sign() * (torch.rand(samples, 1) < share)


@pytest.mark.parametrize("size", [0.01, 1.0, 10.0, 1000.0])
def test_rare_spikes_come_out_near_two(size):
    torch.manual_seed(0)
    normalizer = modules.ObsNormalizer((1,))
    for _ in range(50):
        normalizer.update(contact(0.001, size))
    assert normalizer(torch.tensor([[size]])).item() == pytest.approx(2, rel=0.25)
    assert normalizer(torch.zeros(1, 1)).item() == pytest.approx(0, abs=0.1)
    assert (normalizer.var.rsqrt() * size).item() > 20  # what it would be otherwise: beyond the clip of 10


def test_entries_that_move_often_are_scaled_as_ever():
    torch.manual_seed(0)
    normalizer, x = modules.ObsNormalizer((1,)), contact(0.4, 5.0)
    normalizer.update(x)
    assert torch.equal(normalizer.spread, normalizer.var)
    torch.testing.assert_close(normalizer.var, x.var(0, correction=0))


def test_an_entry_that_never_moved_is_not_blown_up():
    normalizer = modules.ObsNormalizer((2,))
    normalizer.update(torch.tensor([[5.0, 0.0]]).expand(100, 2))
    out = normalizer(torch.tensor([[5.01, 1.0]]))
    torch.testing.assert_close(out, torch.tensor([[0.01, 1.0]]), atol=1e-5, rtol=1e-4)


def test_masked_rows_are_left_out():
    torch.manual_seed(0)
    x, mask = torch.randn(4, 9, 3), torch.rand(4, 9) < 0.6
    some, kept = modules.ObsNormalizer((3,)), modules.ObsNormalizer((3,))
    some.update(x, mask)
    kept.update(x[mask])
    assert torch.equal(some.mean, kept.mean) and torch.equal(some.spread, kept.spread) and some.count == mask.sum()
    some.update(x, torch.zeros_like(mask))
    assert some.count == mask.sum()
    scale, other = modules.ReturnScale(), modules.ReturnScale()
    scale.update(x[..., :1], mask=mask)
    other.update(x[..., 0][mask])
    assert torch.equal(scale.var, other.var)
    with pytest.raises(UserError, match=r"a mask of shape \(4, 8\) does not choose among samples of \(4, 9, 3\)"):
        some.update(x, mask[:, :8])


def test_a_scale_for_each_agent_rescales_the_critic_s_own_layers():
    torch.manual_seed(0)
    env, data = Team(), observations()
    critic, scale = modules.state_value(env, (8,), share_parameters=False), modules.ReturnScale((4, 1))
    before = critic(data.copy())["agents", "state_value"].detach()
    scale.update(torch.randn(50, 4, 1) * torch.tensor([[1.0], [2.0], [3.0], [4.0]]), critic)
    after = critic(data.copy())["agents", "state_value"] * scale.scale
    torch.testing.assert_close(after, before)
    assert scale.scale.flatten().diff().min() > 0.3
    with pytest.raises(UserError, match="the scale has 4 agents, the critic's last layer is one for all"):
        scale.update(torch.randn(50, 4, 1), modules.state_value(env))


def test_rewards_are_divided_by_the_deviation_or_the_largest_of_their_returns():
    # gamma 0.5, one environment, an episode that ends at its third step: G = 1, 2 + 0.5 = 2.5, 3 + 1.25 = 4.25 | 8, 4
    scale = modules.RewardScale(1, gamma=0.5, g_max=2.0)
    rewards, done = torch.tensor([1.0, 2.0, 3.0, 8.0, 0.0]), torch.tensor([False, False, True, False, False])
    for part in (slice(0, 2), slice(2, 5)):  # carried across rollouts
        scale.update(TensorDict({"next": {"reward": rewards[None, part, None], "done": done[None, part, None]}}, [1]))
    returns = torch.tensor([1.0, 2.5, 4.25, 8.0, 4.0])
    torch.testing.assert_close(scale.moments.var, returns.var(correction=0))
    assert scale.returns.tolist() == [4.0] and scale.largest == 8.0
    assert scale.scale.item() == 4.0  # 8 / g_max, above the deviation of 2.34
    scale.g_max = 100.0
    assert scale.scale.item() == pytest.approx(returns.std(correction=0).item())
    batch = TensorDict({"next": {"reward": torch.tensor([[3.0]])}}, [1])
    assert scale(batch)["next", "reward"].item() == pytest.approx(3 / returns.std(correction=0).item())
    assert batch["next", "reward"].item() == 3.0


def test_a_step_that_does_not_count_is_no_reward():
    # an episode of returns 1 and 2.5 (gamma 0.5), the row in which Gymnasium resets, an episode of 8
    rewards, done = torch.tensor([[1.0, 2.0, 0.0, 8.0]]), torch.tensor([[False, True, False, False]])
    rollout = TensorDict({"next": {"reward": rewards[..., None], "done": done[..., None]}}, [1, 4])
    rollout["collector", "mask"] = torch.tensor([[True, True, False, True]])
    scale = modules.RewardScale(1, gamma=0.5)
    scale.update(rollout)
    torch.testing.assert_close(scale.moments.mean, torch.tensor([1.0, 2.5, 8.0]).mean())
