"""Builders for a group of agents: layouts, shared and separate parameters, centralized critics, one agent, errors."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import MultiAgentMLP

from pgkit import advantages, envs, modules
from pgkit.errors import UserError

N, A = 3, 4


class Team(EnvBase):
    """Specs in TorchRL's layout of many agents; nothing is stepped."""

    def __init__(self, agents=A, discrete=False, groups=("agents",), mask=False, state=False):
        super().__init__(batch_size=[N])
        action = Categorical(3, shape=(N, agents)) if discrete else Bounded(-2.0, 2.0, shape=(N, agents, 2))
        own = {"observation": Unbounded((N, agents, 5))}
        own |= {"action_mask": Categorical(2, shape=(N, agents, 3), dtype=torch.bool)} if mask else {}
        team = {name: Composite(own, shape=(N, agents)) for name in groups}
        root = {"state": Unbounded((N, 7))} if state else {}
        self.observation_spec = Composite({**root, **team}, shape=(N,))
        self.action_spec = Composite({name: Composite(action=action, shape=(N, agents)) for name in groups}, shape=(N,))
        self.reward_spec = Composite(
            {name: Composite(reward=Unbounded((N, agents, 1)), shape=(N, agents)) for name in groups}, shape=(N,)
        )

    def _reset(self, tensordict, **kwargs):
        raise NotImplementedError

    def _step(self, tensordict):
        raise NotImplementedError

    def _set_seed(self, seed):
        raise NotImplementedError


class Single(Team):
    def __init__(self, discrete=False):
        EnvBase.__init__(self, batch_size=[N])
        self.observation_spec = Composite(observation=Unbounded((N, 5)), shape=(N,))
        self.action_spec = Categorical(3, shape=(N,)) if discrete else Bounded(-2.0, 2.0, shape=(N, 2))
        self.reward_spec = Unbounded((N, 1))


def batch(agents=A, name="agents", **root):
    torch.manual_seed(3)
    return TensorDict({name: TensorDict({"observation": torch.randn(N, agents, 5)}, [N, agents]), **root}, [N])


ACTORS = {
    "gaussian": (modules.gaussian_actor, False),
    "tanh_normal": (modules.tanh_normal_actor, False),
    "deterministic": (modules.deterministic_actor, False),
    "any": (lambda env, **kw: modules.actor(env, torch.distributions.Normal, distribution_kwargs=None, **kw), False),
    "categorical": (modules.categorical_actor, True),
}
CRITICS = {
    "state_value": (modules.state_value, False, ("agents", "state_value"), (1,)),
    "q_value": (modules.q_value, False, ("agents", "state_action_value"), (2,)),
    "discrete_q_value": (modules.discrete_q_value, True, ("agents", "action_value"), (2, 3)),
}
SHARES = {"one": True, "each": False, "two": (0, 1, 1, 0), "uneven": {"a": 0, "b": 1, "c": 1, "d": 1}}


def outputs(net, data):
    """What a network writes for each agent, parameters of a distribution in place of a draw."""
    out = net(data.copy())["agents"]
    return torch.cat([out[key].flatten(2) for key in ("loc", "scale", "logits") if key in out.keys()] or [
        out["action"]], -1)  # fmt: skip


def agents_that_depend_on(parameter, values):
    """For each index of a parameter's first dimension, the agents whose values have a gradient there."""
    seen = []
    for i in range(values.shape[1]):
        grad = torch.autograd.grad(values[:, i].sum(), parameter, retain_graph=True, allow_unused=True)[0]
        seen.append(grad.abs().flatten(1).sum(1) > 0)
    return torch.stack(seen)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("name", ACTORS)
def test_actors_write_under_the_group(name, share):
    make, discrete = ACTORS[name]
    torch.manual_seed(0)
    if name == "any":
        actor = modules.actor(
            Team(), torch.distributions.Laplace, ["loc", "scale"], share_parameters=SHARES[share],
        )  # fmt: skip
        out = actor.module[0](batch())
        assert out["agents", "loc"].shape == (N, A, 2)
        return
    actor = make(Team(discrete=discrete), share_parameters=SHARES[share])
    out = actor(batch())
    assert out["agents", "action"].shape == ((N, A) if discrete else (N, A, 2))
    if name != "deterministic":
        assert out["agents", "action_log_prob"].shape == (N, A)
    weight = next(p for p in actor.parameters() if p.dim() == (2 if share == "one" else 3))
    if share != "one":
        depend = agents_that_depend_on(weight, outputs(actor, batch()))
        sets = {"each": [0, 1, 2, 3], "two": [0, 1, 1, 0], "uneven": [0, 1, 1, 1]}[share]
        assert torch.equal(depend, nn.functional.one_hot(torch.tensor(sets)).bool())


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("name", CRITICS)
def test_critics_write_under_the_group_and_one_set_is_used_by_its_agents_alone(name, share):
    make, discrete, key, shape = CRITICS[name]
    torch.manual_seed(0)
    critic = make(Team(discrete=discrete), share_parameters=SHARES[share])
    data = batch()
    data["agents", "action"] = torch.randn(N, A, 2)
    values = critic(data.copy())[key]
    assert values.shape == (N, A, *shape)
    assert critic.out_keys == [key]
    one = data.clone()
    one["agents", "observation"][:, 1] += 1  # an agent's value is of its own observation
    changed = (critic(one)[key] != values).flatten(2).any(-1).any(0)
    assert changed.tolist() == [False, True, False, False]


@pytest.mark.parametrize("name", ["q_value", "discrete_q_value"])
@pytest.mark.parametrize("share", ["each", "uneven"])
def test_each_set_of_action_values_is_the_critic_of_its_own_parameters(name, share):
    make, discrete, key, _ = CRITICS[name]
    torch.manual_seed(0)
    critic = make(Team(discrete=discrete), 2, (8,), share_parameters=SHARES[share])
    data = batch()
    data["agents", "action"] = torch.randn(N, A, 2)
    values, sets = critic(data.copy())[key], {"each": [0, 1, 2, 3], "uneven": [0, 1, 1, 1]}[share]
    first, _, last = critic.module.layers
    for agent, own in enumerate(sets):
        x = data["agents", "observation"][:, agent]
        x = x if discrete else torch.cat([x, data["agents", "action"][:, agent]], -1)
        for k in range(2):
            i = k * (max(sets) + 1) + own
            expected = (x @ first.weight[i] + first.bias[i]).relu() @ last.weight[i] + last.bias[i]
            torch.testing.assert_close(values[:, agent, k], expected if discrete else expected.squeeze(-1))
    params = critic.members(TensorDict.from_module(critic), torch.tensor([1]))
    with params.to_module(critic):
        torch.testing.assert_close(critic(data.copy())[key], values[:, :, [1]])


@pytest.mark.parametrize("make,discrete", [*ACTORS.values(), *(value[:2] for value in CRITICS.values())])
@pytest.mark.parametrize("share", [True, False])
def test_a_group_of_one_equals_a_single_agent(make, discrete, share):
    torch.manual_seed(0)
    team = make(Team(agents=1, discrete=discrete), share_parameters=share)
    torch.manual_seed(0)
    single = make(Single(discrete))
    mine, theirs = team.state_dict(), single.state_dict()
    assert mine.keys() == theirs.keys() and all(torch.equal(mine[key], theirs[key]) for key in theirs)
    data = batch(1)
    data["agents", "action"] = torch.randn(N, 1, 2)
    flat = TensorDict({key: x[:, 0] for key, x in data["agents"].items()}, [N])
    if make is ACTORS["any"][0]:
        team, single = team.module[0], single.module[0]
    torch.manual_seed(1)
    out = team(data)["agents"]
    torch.manual_seed(1)
    expected = single(flat)
    assert all(torch.equal(out[key].squeeze(1), expected[key]) for key in single.out_keys)


@pytest.mark.parametrize("name", ["state_value", "q_value", "discrete_q_value"])
@pytest.mark.parametrize(
    "settings", [{}, {"agent_ids": True}, {"share_parameters": False}, {"share_parameters": (0, 1, 1, 1)}]
)
@pytest.mark.parametrize("state", [False, True])
def test_a_centralized_critic_reads_all_agents(name, settings, state):
    make, discrete, key, shape = CRITICS[name]
    torch.manual_seed(0)
    critic = make(Team(discrete=discrete, state=True), centralized="state" if state else True, **settings)
    data = batch(state=torch.randn(N, 7))
    data["agents", "action"] = torch.randn(N, A, 2)
    values = critic(data.copy())[key]
    assert values.shape == (N, A, *shape)
    if settings:
        assert not torch.allclose(values[:, 0], values[:, 1])
    else:
        assert torch.equal(values, values[:, :1].expand_as(values))
    for entry in ["state"] if state else [("agents", "observation")] + [("agents", "action")] * (name == "q_value"):
        other = data.clone()
        other[entry][(slice(None), -1)] += 1.0
        assert (critic(other)[key] != values).flatten(1).any(-1).all()
    other = data.clone()
    other["agents", "observation"] += 1
    assert torch.equal(critic(other)[key], values) == state
    if name == "state_value":
        following = {"agents": data["agents"].select("observation"), "state": data["state"]}
        flags = {name: torch.zeros(N, 1, dtype=torch.bool) for name in ("done", "terminated")}
        rollout = TensorDict({**data.exclude("next"), "next": {**following, "reward": torch.ones(N, 1), **flags}}, [N])
        assert advantages.GAE(critic)(rollout[None])["agents", "advantage"].shape == (1, N, A, 1)


def test_agent_ids_are_a_one_hot_beside_the_observation():
    torch.manual_seed(0)
    critic = modules.state_value(Team(), (), agent_ids=True)
    weight = critic.get_parameter("module.2.weight")[0]
    data = batch()
    expected = data["agents", "observation"] @ weight[:5] + weight[5:]
    torch.testing.assert_close(critic(data)["agents", "state_value"].squeeze(-1), expected)


def test_masked_actions_of_a_group_and_a_mask_that_allows_nothing():
    actor = modules.categorical_actor(Team(discrete=True, mask=True))
    data = batch()
    data["agents", "action_mask"] = torch.ones(N, A, 3, dtype=torch.bool)
    data["agents", "action_mask"][:, 0, 1:] = False
    data["agents", "action_mask"][:, 1] = False
    probs = actor.get_dist(data).probs
    torch.testing.assert_close(probs[:, 0], torch.tensor([[1.0, 0, 0]]).expand(N, 3))
    torch.testing.assert_close(probs[:, 1], torch.full((N, 3), 1 / 3))


@pytest.mark.parametrize("make", [modules.gru, modules.lstm])
@pytest.mark.parametrize("share", [True, False])
def test_memory_of_each_agent(make, share):
    torch.manual_seed(0)
    env = Team()
    core = make(env, 6, (8,), share_parameters=share)
    actor, critic = modules.gaussian_actor(env, encoder=core), modules.state_value(env, encoder=core)
    assert core.state_shape == (A, core.state_size)
    assert ("agents", "recurrent_state") in actor.in_keys and ("next", "agents", "recurrent_state") in actor.out_keys
    steps, torch_seed = 5, 4
    torch.manual_seed(torch_seed)
    x, state = torch.randn(N, steps, A, 5), torch.randn(N, steps, A, core.state_size)
    is_init = torch.zeros(N, steps, 1, dtype=torch.bool)
    is_init[0, 2] = True
    features, states = core(x, is_init, state)
    assert features.shape == (N, steps, A, 6)
    carried = state[:, 0]
    for t in range(steps):  # a sequence is its steps
        one, carried = core(x[:, t], is_init[:, t], carried)
        torch.testing.assert_close(features[:, t], one)
        torch.testing.assert_close(states[:, t], carried)
    afresh, _ = core(x[:, 2:], is_init[:, 2:], torch.zeros_like(state[:, 2:]))
    torch.testing.assert_close(features[0, 2:], afresh[0])  # an episode that begins has no memory
    other = x.clone()
    other[:, 0, 1] += 1
    changed = (core(other, is_init, state)[0] != features).flatten(3).any(-1)
    assert changed[1].any(0).tolist() == [False, True, False, False]  # nor one agent another's
    data = batch(is_init=torch.zeros(N, 1, dtype=torch.bool))
    data["agents", "recurrent_state"] = torch.randn(N, A, core.state_size)
    out = actor(data.copy())
    assert out["next", "agents", "recurrent_state"].shape == (N, A, core.state_size)
    assert critic(data.copy())["agents", "state_value"].shape == (N, A, 1)


def test_torchrl_s_network_as_an_encoder():
    net = MultiAgentMLP(5, 16, A, centralized=True, share_params=False, depth=1, num_cells=8)
    actor = modules.gaussian_actor(Team(), encoder=net)
    assert actor(batch())["agents", "action"].shape == (N, A, 2)


def test_a_normalizer_of_all_agents():
    normalizer = modules.ObsNormalizer(Team())
    data = batch()
    normalizer.update(data["agents", "observation"])
    torch.testing.assert_close(normalizer.mean, data["agents", "observation"].mean((0, 1)))
    modules.gaussian_actor(Team(), normalizer=normalizer)(data)


@pytest.mark.parametrize("kind", [modules.GaussianExploration, modules.OrnsteinUhlenbeck])
def test_exploration_of_a_group(kind):
    actor = kind(modules.deterministic_actor(Team()), Team(), std=0.3)
    data = batch(is_init=torch.zeros(N, 1, dtype=torch.bool))
    data["agents", "recurrent_state"] = torch.zeros(N, A, 2)
    first, second = (actor(data.copy())["agents", "action"] for _ in range(2))
    assert first.shape == (N, A, 2) and not torch.equal(first, second)
    assert kind is modules.GaussianExploration or actor.state_shape == (N and A, 2)


def test_errors_are_one_clear_line():
    two = Team(groups=("speaker", "listener"))
    with pytest.raises(UserError, match="has the groups speaker, listener: say which, group='speaker'"):
        modules.gaussian_actor(two)
    assert modules.gaussian_actor(two, group="listener").out_keys[0] == ("listener", "loc")
    with pytest.raises(UserError, match="no group 'teachers', only speaker, listener"):
        modules.state_value(two, group="teachers")
    with pytest.raises(UserError, match="no group 'agents', only one agent"):
        modules.state_value(Single(), group="agents")
    with pytest.raises(UserError, match="centralized= is for a group of agents"):
        modules.state_value(Single(), centralized=True)
    with pytest.raises(UserError, match="share_parameters= and agent_ids= are for a group"):
        modules.gaussian_actor(Single(), agent_ids=True)
    with pytest.raises(UserError, match="no observation 'action', only .*observation"):
        modules.state_value(Team(), centralized="action")
    with pytest.raises(UserError, match=r"share_parameters=\(0, 2, 1\): give the number of a set"):
        modules.gaussian_actor(Team(), share_parameters=(0, 2, 1))
    with pytest.raises(UserError, match="go to the recurrent encoder's builder"):
        modules.gaussian_actor(Team(), encoder=modules.gru(Team()), agent_ids=True)
    with pytest.raises(
        UserError, match=r"gives \(1, 20\) for an observation \(1, 4, 5\), expected \(1, 4, 'features'\)"
    ):
        modules.gaussian_actor(Team(), encoder=nn.Flatten())


def test_agents_of_different_spaces_are_refused():
    env = Team()
    parts = [Composite(observation=Unbounded((n,)), shape=()) for n in (5, 5, 5, 6)]
    env.observation_spec = Composite(agents=torch.stack(parts).expand(N, A), shape=(N,))
    with pytest.raises(UserError, match="the agents of group 'agents' have different spaces"):
        modules.gaussian_actor(env)


def test_modules_are_built_on_the_device_and_what_is_handed_in_stays():
    env = envs.make("Pendulum-v1")
    encoder, normalizer = nn.Linear(3, 5), modules.ObsNormalizer(env)
    for make in (modules.gaussian_actor, modules.tanh_normal_actor, modules.deterministic_actor, modules.state_value,
                 modules.q_value, modules.gru, modules.lstm):  # fmt: skip
        assert {p.device.type for p in make(env, device="meta").parameters()} == {"meta"}
        with pytest.raises(UserError, match="encoder=Linear lies on cpu, the rest is built on meta: give device='cpu'"):
            make(env, encoder=encoder, device="meta")
        net = make(env, normalizer=normalizer, device="meta")
        assert normalizer.mean.device.type == "cpu" and encoder.weight.device.type == "cpu"
        assert {x.device.type for name, x in net.named_buffers() if "mean" not in name and x.shape == (1,)} <= {"meta"}
    assert {x.device.type for x in modules.ObsNormalizer(env, device="meta").buffers()} == {"meta"}


def test_specs_of_a_simulator_are_enough():
    env = Single()
    plain = SimpleNamespace(observation_spec=env.observation_spec, action_spec=env.full_action_spec)
    data = TensorDict({"observation": torch.zeros(N, 5)}, [N])
    assert modules.tanh_normal_actor(plain)(data)["action"].shape == (N, 2)
    assert modules.q_value(plain)(data)["state_action_value"].shape == (N, 2)
    with pytest.raises(UserError, match="sizes are read off a TorchRL environment, this is a str"):
        modules.gaussian_actor("Pendulum-v1")


def test_a_recurrent_critic_of_a_group_is_estimated_from():
    torch.manual_seed(0)
    env, steps = Team(), 6
    core = modules.gru(env, 3, (4,))
    critic = modules.state_value(env, encoder=core)
    observation, is_init = torch.randn(N, steps + 1, A, 5), torch.zeros(N, steps + 1, 1, dtype=torch.bool)
    state = torch.zeros(N, steps + 1, A, 3)
    for t in range(steps):
        state[:, t + 1] = core(observation[:, t], is_init[:, t], state[:, t])[1].detach()

    def entries(part):
        own = TensorDict({"observation": observation[:, part], "recurrent_state": state[:, part]}, [N, steps, A])
        return {"agents": own, "is_init": is_init[:, part]}

    ended = {key: torch.zeros(N, steps, 1, dtype=torch.bool) for key in ("done", "terminated")}
    after = {**entries(slice(1, None)), **ended, "reward": torch.randn(N, steps, 1)}
    rollout = TensorDict({**entries(slice(steps)), "next": after}, [N, steps])
    out = advantages.GAE(critic, gamma=0.9, lmbda=0.0)(rollout.clone())
    next_value = critic(rollout["next"].reshape(-1))["agents", "state_value"].detach().reshape(N, steps, A, 1)
    expected = rollout["next", "reward"].unsqueeze(2) + 0.9 * next_value
    torch.testing.assert_close(out["agents", "value_target"], expected)
