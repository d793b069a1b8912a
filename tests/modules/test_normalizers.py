import pytest
import torch

from pgkit import envs, modules


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
