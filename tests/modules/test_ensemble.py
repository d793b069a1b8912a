"""Blocks of critic ensembles: each member is a network of its own, statistics, dropout, members taken out."""

from functools import partial
from typing import Any, cast

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import nn
from torchrl.modules import BatchRenorm1d

from pgkit import envs, heads, modules

BLOCKS = {
    "mlp": {},
    "layer norm": {"norm": modules.EnsembleLayerNorm},
    "droq": {"norm": modules.EnsembleLayerNorm, "dropout": 0.2},
    "crossq": {"body": partial(modules.batch_renorm_mlp, hidden=(8, 8))},
    "simba": {"body": partial(modules.simba, width=8, blocks=2)},
    "flash": {"body": partial(modules.flash, width=8, blocks=2)},
}


def critics(num=3, **kwargs):
    return modules.q_value(envs.make("Pendulum-v1"), num, (8, 8), **kwargs)


def batch(size=16):
    return TensorDict({"observation": torch.randn(size, 3), "action": torch.randn(size, 1)}, [size])


@pytest.mark.parametrize("block", BLOCKS)
def test_members_alone_give_what_they_give_among_the_others(block):
    net = critics(4, head=heads.Quantiles(5), **BLOCKS[block]).eval()
    for p in net.parameters():
        p.data += 0.1 * torch.randn_like(p)
    data, index = batch(), torch.tensor([3, 1])
    whole = net(data.copy())["state_action_value"]
    assert whole.shape == (16, 4, 5)
    params = TensorDict.from_module(net)
    with net.members(params, index).to_module(net):
        some = net(data.copy())["state_action_value"]
    torch.testing.assert_close(some, whole[:, index])
    assert not torch.allclose(whole[:, 0], whole[:, 1], atol=1e-3)
    torch.testing.assert_close(net(data.copy())["state_action_value"], whole)  # the network is as it was


def test_layer_norm_is_that_of_each_member():
    norm = modules.EnsembleLayerNorm(2, 6)
    nn.init.normal_(norm.weight)
    nn.init.normal_(norm.bias)
    x = torch.randn(2, 5, 6) * 3 + 1
    for k in range(2):
        torch.testing.assert_close(norm(x)[k], F.layer_norm(x[k], (6,), norm.weight[k, 0], norm.bias[k, 0]))


def test_rms_norm_is_that_of_each_member():
    norm = modules.EnsembleRMSNorm(2, 6)
    nn.init.normal_(norm.weight)
    x = torch.randn(2, 5, 6) * 3 + 1
    for k in range(2):
        torch.testing.assert_close(norm(x)[k], F.rms_norm(x[k], (6,), norm.weight[k, 0], 1e-6))


def test_flash_is_batch_norm_linear_blocks_and_rms_norm():
    layers, width = modules.flash(2, 5, width=4, blocks=1, expansion=3)
    for layer in layers:
        for p in layer.parameters():
            nn.init.normal_(p)
    x = torch.randn(2, 16, 5) * 2 + 1
    norm, first, block, last = cast(Any, layers)

    def normed(x, layer, k):
        return F.batch_norm(x, None, None, layer.weight[k, 0], layer.bias[k, 0], training=True)

    for k in range(2):
        y = normed(x[k], norm, k) @ first.weight[k]
        inner = normed(y @ block.inner.weight[k], block.inner_norm, k).relu()
        y = y + normed(inner @ block.outer.weight[k], block.outer_norm, k).relu()
        y = F.rms_norm(y, (4,), last.weight[k, 0], 1e-6)
        torch.testing.assert_close(nn.Sequential(*layers)(x)[k], y, atol=1e-4, rtol=1e-4)
    assert width == 4 and block.inner.weight.shape == (2, 4, 12) and first.bias is None


def test_projection_gives_weights_their_length_and_keeps_their_direction():
    net = critics(2, body=partial(modules.flash, width=8, blocks=1))
    for p in net.parameters():
        nn.init.normal_(p, std=3.0)
    before = {name: p.detach().clone() for name, p in net.named_parameters()}
    plain = nn.Linear(3, 2)
    modules.WeightProjection(net, plain)
    torch.testing.assert_close(plain.weight.norm(dim=1), torch.ones(2))  # [out, in]
    norm, linear, block, rms, last = net.module.layers
    for layer in (linear, block.inner, block.outer, last):  # [critics, in, out]
        torch.testing.assert_close(layer.weight.norm(dim=1), torch.ones_like(layer.weight[:, 0]))
    for layer in (norm, block.inner_norm, block.outer_norm):
        length = torch.cat([layer.weight, layer.bias], -1).norm(dim=-1)
        torch.testing.assert_close(length, torch.full_like(length, layer.weight.shape[-1] ** 0.5))
    torch.testing.assert_close(rms.weight.norm(dim=-1), torch.full((2, 1), 8**0.5))
    after = dict(net.named_parameters())
    ratio = after["module.layers.0.weight"] / before["module.layers.0.weight"]
    torch.testing.assert_close(ratio, ratio[..., :1].expand_as(ratio))
    assert torch.equal(after["module.layers.4.bias"], before["module.layers.4.bias"])


def test_dropout_differs_across_members_and_rows_and_is_off_in_evaluation():
    net = critics(2, dropout=0.5)
    masks = []
    net.module.layers[1].register_forward_hook(lambda module, args, out: masks.append(out == 0))
    data = batch(64)
    for _ in range(2):
        net(data.copy())
    first, second = masks
    for a, b in ((first[0], first[1]), (first[0, :32], first[0, 32:]), (first, second)):
        assert 0.4 < (a != b).float().mean() < 0.6  # independent masks differ in half the places
    net.eval()
    assert torch.equal(net(data.copy())["state_action_value"], net(data.copy())["state_action_value"])


@pytest.mark.parametrize("p", [0.01, 0.1, 0.5])
def test_zeros_of_dropout_are_as_many_as_they_should_be_and_independent(p):
    torch.manual_seed(0)
    dropout, ones = modules.EnsembleDropout(p), torch.ones(2, 1000, 500)
    out = dropout(ones)
    assert out.unique().tolist() == pytest.approx([0, 1 / (1 - p)])
    a, b = out == 0, dropout(ones) == 0
    corners = [a[:, i : i + 500, j : j + 250] for i in (0, 500) for j in (0, 250)]
    both = [a & b, a[0] & a[1], corners[0] & corners[1], corners[0] & corners[2], corners[0] & corners[3]]
    three, four = corners[0] & corners[1] & corners[2], corners[0] & corners[1] & corners[2] & corners[3]
    for zeros, probability in ((a, p), *((pair, p**2) for pair in both), (three, p**3), (four, p**4)):
        deviation = (probability * (1 - probability) / zeros.numel()) ** 0.5
        assert abs(zeros.double().mean().item() - probability) < 5 * deviation + 1e-5
    for dim, size in ((1, 1000), (2, 500)):  # the number of zeros in a column and in a row is binomial
        assert a.double().mean(dim).std().item() == pytest.approx((p * (1 - p) / size) ** 0.5, rel=0.12)


def test_batch_renorm_by_hand():
    # x = 1, 3: mean 2, variance 1. running mean 1, variance 4: std 2. r = 1/2, d = (2 - 1)/2 = 1/2
    # y = -1 * 1/2 + 1/2 = 0 and 1 * 1/2 + 1/2 = 1, which is (x - 1) / 2: within the bounds, renorm is the running norm
    norm = modules.EnsembleBatchRenorm(1, 1, momentum=0.25, eps=0.0, warmup=0).double()
    norm.mean.fill_(1)
    norm.var.fill_(4)
    x = torch.tensor([[[1.0], [3.0]]], dtype=torch.float64)
    assert norm(x).flatten().tolist() == [0, 1]
    # 1 + (2 - 1)/4, 4 + (1 - 4)/4
    assert (norm.mean.item(), norm.var.item(), norm.steps.item()) == (1.25, 3.25, 1)
    norm.eval()
    torch.testing.assert_close(norm(x).flatten(), (torch.tensor([1.0, 3.0]).double() - 1.25) / 3.25**0.5)
    assert norm.steps.item() == 1
    warm = modules.EnsembleBatchRenorm(1, 1, eps=0.0, warmup=1).double()
    warm.mean.fill_(1)
    assert warm(x).flatten().tolist() == [-1, 1]  # plain batch norm in the first step
    assert warm(x).flatten().tolist() != [-1, 1]


def test_batch_renorm_agrees_with_torchrl_s():
    # theirs multiplies the correction by steps // warmup_steps, which is right up to the second such span
    ours = modules.EnsembleBatchRenorm(2, 4, eps=1e-5, r_max=1.5, d_max=0.5, warmup=3).double()
    theirs = [BatchRenorm1d(4, max_r=1.5, max_d=0.5, warmup_steps=3).double() for _ in range(2)]
    for _ in range(5):
        x = torch.randn(2, 200, 4, dtype=torch.float64) * 2 + 1
        expected = torch.stack([norm(part) for norm, part in zip(theirs, x, strict=True)])
        torch.testing.assert_close(ours(x), expected)
        for k, norm in enumerate(theirs):
            torch.testing.assert_close(ours.mean[k, 0], norm.running_mean)
            norm.running_var.copy_(ours.var[k, 0])  # theirs divides by B - 1
    for norm in theirs:
        norm.eval()
    torch.testing.assert_close(ours.eval()(x), torch.stack([n(part) for n, part in zip(theirs, x, strict=True)]))


def test_statistics_move_only_where_the_layer_s_own_weights_learn():
    norm = modules.EnsembleBatchRenorm(1, 2)
    x = torch.randn(1, 8, 2, requires_grad=True)
    with torch.no_grad():
        norm(x)
    params = TensorDict.from_module(norm).detach()
    with params.to_module(norm, preserve_module_state=False):
        out = norm(x)
    assert norm.steps.item() == 0 and norm.mean.abs().sum() == 0 and out.requires_grad
    norm(x)
    assert norm.steps.item() == 1 and norm.mean.abs().sum() > 0


def test_simba_is_a_residual_network_of_normalized_observations():
    env = envs.make("Pendulum-v1")
    normalizer = modules.ObsNormalizer(env)
    net = modules.q_value(env, 2, body=partial(modules.simba, width=4, blocks=1), normalizer=normalizer)
    data = batch(5)
    embed, block, _, last = net.module.layers
    nn.init.normal_(block.norm.bias)
    before = torch.zeros(())
    for _ in range(2):
        x = torch.cat([normalizer(data["observation"]), data["action"]], -1)
        value = net(data.copy())["state_action_value"]
        for k in range(2):
            h = x @ embed.weight[k] + embed.bias[k]
            inner = F.layer_norm(h, (4,), block.norm.weight[k, 0], block.norm.bias[k, 0])
            h = h + (inner @ block.inner.weight[k] + block.inner.bias[k]).relu() @ block.outer.weight[k]
            h = F.layer_norm(h, (4,))
            torch.testing.assert_close(value[:, k], (h @ last.weight[k] + last.bias[k]).squeeze(-1))
        assert (value - before).abs().min() > 1e-6
        before = value
        normalizer.update(torch.randn(50, 3) * 4 + 2)


def test_a_body_as_an_actor_s_encoder():
    env = envs.make("Pendulum-v1")
    for body in (partial(modules.simba, width=8, blocks=1), partial(modules.batch_renorm_mlp, hidden=(8,))):
        encoder = modules.Encoder(env, body)
        assert encoder(torch.randn(4, 5, 3)).shape == (4, 5, 8) and encoder(torch.randn(3)).shape == (8,)
        actor = modules.tanh_normal_actor(env, encoder=encoder)
        assert actor(TensorDict({"observation": torch.randn(4, 3)}, [4]))["action"].shape == (4, 1)
