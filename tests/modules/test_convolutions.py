"""Encoders of images: sizes, types, what is refused, which loss trains what; augmentation and decoder."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate

from pgkit import controllers, losses, modules
from pgkit.compiled.native import record
from pgkit.errors import UserError
from pgkit.functional import quantized_pixels
from tests.modules.test_groups import Team

N = 5


class Camera(Team):
    """Specs of a vector of environments that observe images; nothing is stepped."""

    def __init__(self, *shape, spec=None, key="observation"):
        EnvBase.__init__(self, batch_size=[N])
        picture = spec or Unbounded((N, *shape), dtype=torch.uint8)
        self.observation_spec = Composite({key: picture}, shape=(N,))
        self.action_spec = Bounded(-1.0, 1.0, shape=(N, 2))
        self.reward_spec = Unbounded((N, 1))


def images(*shape):
    torch.manual_seed(1)
    return torch.randint(256, shape, dtype=torch.uint8)


@pytest.mark.parametrize(
    "kind,shape,last,features",
    [
        ("drq", (9, 84, 84), (32, 35, 35), 50),
        ("nature", (4, 84, 84), (64, 7, 7), 512),
        ("small", (3, 7, 7), (64, 4, 4), 64),
        (None, (3, 64, 48), (32, 25, 17), 50),
        (None, (3, 7, 7), (64, 4, 4), 64),
        (None, (3, 3, 64, 64), (32, 25, 25), 50),  # three frames of three channels
    ],
)
def test_sizes_and_leading_dimensions(kind, shape, last, features):
    env = Camera(*shape)
    encoder = modules.conv_encoder(env, kind)
    assert encoder.sizes[-1] == last and encoder.features == features
    x = images(2, 3, *shape)
    out = encoder(x)
    assert out.shape == (2, 3, features)
    torch.testing.assert_close(out[1, 2], encoder(x[1, 2]), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(out, encoder(x / 255))
    actor, critic = modules.tanh_normal_actor(env, encoder=encoder), modules.q_value(env, encoder=encoder)
    batch = TensorDict({"observation": images(N, *shape)}, [N])
    assert critic(actor(batch))["state_action_value"].shape == (N, 2)


def test_what_does_not_fit_is_said_in_one_line():
    with pytest.raises(
        UserError, match="7x7 are too small for kind='nature', which takes 36x36 and more: kind='small' takes 4x4"
    ):
        modules.conv_encoder(Camera(3, 7, 7), "nature")
    with pytest.raises(UserError, match="3x3 are too small for kind='small'.*use a perceptron"):
        modules.conv_encoder(Camera(3, 3, 3))
    with pytest.raises(
        UserError, match=r"shape \(84, 84, 3\), its channels come last: they are read first, \(3, 84, 84\)"
    ):
        modules.conv_encoder(Camera(84, 84, 3))
    with pytest.raises(UserError, match="its channels come last"):
        modules.conv_encoder(Camera(4, 64, 64, 3))
    with pytest.raises(UserError, match=r"'observation' has shape \(4,\), which is no image"):
        modules.conv_encoder(Camera(4))
    with pytest.raises(UserError, match="a float image from 0 to 255, expected"):
        modules.conv_encoder(Camera(spec=Bounded(0.0, 255.0, (N, 3, 32, 32))))
    with pytest.raises(UserError, match="images are uint8, or floats"):
        modules.conv_encoder(Camera(spec=Unbounded((N, 3, 32, 32), dtype=torch.int64)))
    with pytest.raises(UserError, match="kind='resnet': choose one of drq, nature, small"):
        modules.conv_encoder(Camera(3, 32, 32), "resnet")
    floats = modules.conv_encoder(Camera(spec=Unbounded((N, 3, 32, 32))))
    with pytest.raises(UserError, match=r"float images must lie within \[0, 1\], these are from 0 to 255"):
        floats(torch.tensor([0.0, 255.0]).repeat(3 * 32 * 16).reshape(1, 3, 32, 32))
    with pytest.raises(UserError, match=r"built for images \(3, 32, 32\), these are \(32, 32, 3\)"):
        floats(torch.zeros(N, 32, 32, 3))
    with pytest.raises(UserError, match="convolutions are shared between equal ones"):
        modules.conv_encoder(Camera(3, 32, 32), shared=modules.conv_encoder(Camera(3, 40, 40)))


def gradients(out, net):
    return [torch.autograd.grad(out, p, retain_graph=True, allow_unused=True)[0] for p in net.parameters()]


def test_the_critic_s_loss_alone_trains_shared_convolutions():
    torch.manual_seed(0)
    env = Camera(3, 20, 20)
    encoder = modules.conv_encoder(env)
    own = modules.conv_encoder(env, shared=encoder, detach=True)
    actor, critic = modules.tanh_normal_actor(env, encoder=own), modules.q_value(env, encoder=encoder)
    loss = losses.SACLoss(actor, critic, gamma=0.9, temperature=controllers.FixedTemperature(0.1))
    batch = actor(TensorDict({"observation": images(N, 3, 20, 20)}, [N])).detach()
    flag = torch.zeros(N, 1, dtype=torch.bool)
    batch["next"] = TensorDict(
        {"observation": images(N, 3, 20, 20), "reward": torch.randn(N, 1), "done": flag, "terminated": flag}, [N]
    )
    SoftUpdate(loss, tau=0.01)  # TorchRL warns without
    out = loss(batch)
    assert encoder.convolutions is own.convolutions
    trained = {name: [g is not None and bool(g.any()) for g in gradients(out[name], encoder.convolutions)]
               for name in ("loss_actor", "loss_qvalue")}  # fmt: skip
    assert not any(trained["loss_actor"]) and all(trained["loss_qvalue"])
    assert all(g is not None and bool(g.any()) for g in gradients(out["loss_actor"], own.trunk))
    assert all(g is None for g in gradients(out["loss_qvalue"], own.trunk))
    assert all(g is not None for g in gradients(out["loss_qvalue"], encoder.trunk))


@pytest.mark.parametrize("detached", [False, True])
def test_a_detached_encoder_of_one_s_own(detached):
    env = Camera(3, 20, 20)
    encoder = modules.conv_encoder(env)
    actor = modules.gaussian_actor(env, encoder=modules.Detached(encoder) if detached else encoder)
    loc = actor.get_dist(TensorDict({"observation": images(N, 3, 20, 20)}, [N])).base_dist.loc
    assert [g is None for g in gradients(loc.sum(), encoder)] == [detached] * len(list(encoder.parameters()))


def test_a_frozen_encoder_of_the_user_s_in_three_lines():
    env = Camera(3, 32, 32)
    net = nn.Sequential(nn.Conv2d(3, 8, 3, 2), nn.BatchNorm2d(8), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten())

    class Pretrained(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = net.eval().requires_grad_(False)

        def forward(self, x):
            return self.net(x.float() / 255)

    actor, critic = (make(env, encoder=Pretrained()) for make in (modules.gaussian_actor, modules.state_value))
    batch = TensorDict({"observation": images(N, 3, 32, 32)}, [N])
    before = {name: x.clone() for name, x in net.state_dict().items()}
    assert critic(actor(batch))["state_value"].shape == (N, 1)
    assert all(torch.equal(before[name], x) for name, x in net.state_dict().items())
    trained = [p for p in actor.parameters() if p.requires_grad]
    assert sum(p.numel() for p in trained) == 8 * 2 + 2 + 2  # the head alone: mean and log_std


def test_the_images_of_another_entry_and_of_a_group():
    encoder = modules.conv_encoder(Camera(3, 16, 16, key="pixels"), key="pixels")
    env = Camera(3, 16, 16, key="pixels")
    assert modules.gaussian_actor(env, encoder=encoder).in_keys == ["pixels"]
    team = Team()
    pixels = Composite(observation=Unbounded((3, 4, 3, 16, 16), dtype=torch.uint8), shape=(3, 4))
    team.observation_spec = Composite(agents=pixels, shape=(3,))
    actor = modules.gaussian_actor(team, encoder=modules.conv_encoder(team), share_parameters=False)
    batch = TensorDict({"agents": TensorDict({"observation": images(3, 4, 3, 16, 16)}, [3, 4])}, [3])
    assert actor(batch)["agents", "action"].shape == (3, 4, 2)


SHAPES = [
    ("drq", (9, 84, 84)),
    ("drq", (3, 21, 32)),
    ("nature", (4, 84, 84)),
    ("nature", (4, 86, 87)),
    ("small", (3, 7, 7)),
]


@pytest.mark.parametrize("kind,shape", SHAPES)
def test_the_decoder_gives_the_image_s_shape(kind, shape):
    encoder = modules.conv_encoder(Camera(*shape), kind)
    assert modules.decoder(encoder)(torch.zeros(2, encoder.features)).shape == (2, *shape)


def test_encoder_and_decoder_learn_to_reconstruct():
    torch.manual_seed(0)
    encoder = modules.conv_encoder(Camera(1, 16, 16))
    decoder = modules.decoder(encoder)
    x = (images(8, 1, 1, 1).expand(8, 1, 16, 16) // 2).contiguous()
    optimizer = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], 1e-3)
    errors = []
    for _ in range(120):
        error = (decoder(encoder(x)) - quantized_pixels(x)).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.1 * errors[0]


def test_random_shift_moves_each_row_and_entry_by_itself():
    torch.manual_seed(0)
    column = torch.arange(16, dtype=torch.uint8).expand(2, 16, 16)  # a pixel's value is its column
    x = column.expand(64, 2, 16, 16).contiguous()
    batch = TensorDict({"observation": x, "next": {"observation": x.clone(), "reward": torch.zeros(64, 1)}}, [64])
    out = modules.random_shift(4)(batch)
    assert out["observation"].dtype == torch.uint8 and torch.equal(batch["observation"], x)
    right = 8 - out["observation"][:, :, :, 8].long()
    assert (right == right[:, :1, :1]).all()  # all channels and rows alike
    assert set(right[:, 0, 0].tolist()) == set(range(-4, 5))
    assert not torch.equal(out["observation"], out["next", "observation"])
    assert out["next", "reward"].shape == (64, 1)
    assert torch.equal(modules.random_shift(0)(batch)["observation"], x)
    with_others = modules.random_shift(keys=["pixels"])(TensorDict({"observation": x, "pixels": x}, [64]))
    assert torch.equal(with_others["observation"], x) and not torch.equal(with_others["pixels"], x)


def test_random_shift_is_part_of_a_graph():
    shift = modules.random_shift(2)

    def run(x):
        return [shift(TensorDict({"observation": x}, [4]))["observation"]]

    x = images(4, 3, 12, 12)
    graph = record(run, [x])
    torch.manual_seed(5)
    first = graph(x)[0]
    torch.manual_seed(5)
    assert torch.equal(first, run(x)[0])
    assert not torch.equal(first, graph(x)[0])  # drawn anew
