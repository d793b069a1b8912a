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
