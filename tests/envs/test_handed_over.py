"""What environments hand over is looked at in every step and reset, and one line names what is wrong."""

import copy
import logging
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from pgkit import collectors, envs, modules
from pgkit.envs import once
from pgkit.errors import UserError

VECTOR = spaces.Box(-1, 1, (3,), np.float32)


class Faulty(gym.Env):
    """Episodes of ten steps with a reward of 1. From the fifth step on, it returns what ``wrong`` says instead."""

    observation_space: Any = VECTOR
    action_space: Any = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, wrong: dict[str, Any] | None = None) -> None:
        self.wrong, self.steps, self.episodes, self.seeds, self.options = wrong or {}, 0, 0, [], []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t, self.episodes = 0, self.episodes + 1
        self.seeds.append(seed)
        self.options.append(options)
        given = (self._observation(), {})
        return self.wrong["reset"](given) if self.episodes > 2 and "reset" in self.wrong else given

    def step(self, action: Any) -> Any:
        self.t, self.steps = self.t + 1, self.steps + 1
        result = {"obs": self._observation(), "reward": 1.0, "terminated": self.t == 10, "truncated": False, "info": {}}
        if self.steps >= 5:
            result |= {key: value for key, value in self.wrong.items() if key in result}
        if self.steps >= 5 and "result" in self.wrong:
            return self.wrong["result"]
        return tuple(result.values())

    def _observation(self) -> Any:
        if self.observation_space is VECTOR:
            return self.np_random.uniform(-1, 1, 3).astype(np.float32)
        return self.observation_space.sample()


def collect(made: Any, steps: int = 40, num_envs: int = 2, **kwargs: Any) -> Any:
    env = envs.make(made, num_envs=num_envs, **kwargs)
    actor = modules.gaussian_actor(env, (4,))
    return collectors.VectorCollector(env, actor, frames_per_batch=num_envs * steps, compile="off").rollout()


ONES = np.ones(3, np.float32)
WRONG_OBSERVATIONS = {
    "shape (1,)": ONES[:1], "a scalar": np.float32(1), "None": None, "one more": np.ones(4, np.float32),
    "a batch of one": ONES[None], "a list with None": [1.0, None, 2.0], "text": ["1", "2", "3"],
    "objects": np.array([1, None, 2], object), "complex numbers": np.array([1j, 1, 2]), "a dict": {"a": ONES},
}  # fmt: skip


@pytest.mark.fault(
    kind=1,
    injected="a later observation of another shape or type: (1,), a scalar, None, text, objects, complex numbers",
    outcome="one line names environment, method, what was found and what the space says",
)
@pytest.mark.parametrize("wrong", WRONG_OBSERVATIONS.values(), ids=WRONG_OBSERVATIONS)
def test_a_later_observation_of_another_kind(wrong: Any):
    with pytest.raises(
        UserError, match=r"Faulty.step returned an observation .* of its observation_space: (shape|type)"
    ):
        collect(partial(Faulty, {"obs": wrong}))
    with pytest.raises(UserError, match="Faulty.reset returned an observation that is not of its observation_space"):
        collect(partial(Faulty, {"reset": lambda given: (wrong, given[1])}))


@pytest.mark.fault(
    kind=1,
    injected="flags and rewards of other types: 'False', None, 2, NaN, '5', arrays, complex numbers",
    outcome="one line says what to return; bool, 0 and 1, NumPy's and torch's scalars count as they are",
)
def test_flags_and_rewards_of_other_types():
    for flag in ("False", None, 2, float("nan"), 1.0, np.array([True]), []):
        for name in ("terminated", "truncated"):
            with pytest.raises(UserError, match=rf"Faulty.step returned {name}=.*: return True or False"):
                collect(partial(Faulty, {name: flag}))
    for reward in ("5", None, 1j, np.ones(1), [1.0, 2.0], object()):
        with pytest.raises(UserError, match=r"Faulty.step returned a reward .*float\(reward\)"):
            collect(partial(Faulty, {"reward": reward}))
    usual = {"reward": np.array(2), "terminated": 0, "truncated": torch.tensor(False)}
    assert collect(partial(Faulty, usual))["next", "reward"][:, 4:].eq(2).all()


@pytest.mark.fault(
    kind=1,
    injected="a step that returns four values or None, a third reset that returns the observation alone",
    outcome="one line says which tuple to return",
)
def test_results_that_are_no_tuples():
    for result in ((ONES, 1.0, False, {}), None, ONES, [ONES, 1.0, False, False, {}]):
        with pytest.raises(UserError, match=r"Faulty.step returned .*return the tuple \(observation, reward"):
            collect(partial(Faulty, {"result": result}))
    for change in (lambda x: x[0], lambda x: (*x, 1), lambda x: list(x), lambda x: (x[0], None)):
        with pytest.raises(UserError, match=r"Faulty.reset returned .*return the tuple \(observation, info\)"):
            collect(partial(Faulty, {"reset": change}))


class Parts(Faulty):
    observation_space = spaces.Dict(a=VECTOR, b=spaces.Box(-1, 1, (2,), np.float32), c=spaces.Discrete(3, start=2))

    def __init__(self, change: dict[str, Any]) -> None:
        super().__init__()
        self.change = change

    def step(self, action: Any) -> Any:
        obs, *rest = super().step(action)
        changed = {**obs, **self.change} if self.steps >= 5 else obs
        return ({key: x for key, x in changed.items() if x is not None}, *rest)


@pytest.mark.fault(
    kind=1,
    injected="an entry of a Dict that is missing, of another shape, or outside its Discrete space",
    outcome="one line names the entry or what its space says; equal sizes in sum do not hide it",
)
def test_entries_of_a_dict():
    rollout = collect(partial(Parts, {}))
    assert rollout["observation"].shape == (2, 40, 8) and (rollout["observation"][..., 5:].sum(-1) == 1).all()
    for change, message in {
        "the entry 'b' is missing": {"b": None},
        r"shape \(2,\), its space says \(3,\)": {"a": np.ones(2, np.float32), "b": ONES},
        r"5, its space says whole numbers from \[2\] to \[4\]": {"c": 5},
        r"1, its space says whole numbers": {"c": 1},
        r"2.5, its space says whole numbers": {"c": 2.5},
    }.items():
        with pytest.raises(UserError, match=change):
            collect(partial(Parts, message))


class FaultyVector(SyncVectorEnv):
    def __init__(self, wrong: dict[int, Any]) -> None:
        super().__init__([Faulty] * 2)
        self.wrong, self.steps = wrong, 0

    def step(self, actions: Any) -> Any:
        result, self.steps = list(super().step(actions)), self.steps + 1
        for place, x in (self.wrong if self.steps > 3 else {}).items():
            result[place] = x
        return tuple(result)


@pytest.mark.fault(
    kind=1,
    injected="a vector environment whose observations, rewards or flags have other shapes or types",
    outcome="one line names the vector, the entry, shape and type, and what is expected",
)
def test_vectors_of_environments():
    for wrong in (ONES, np.ones((2, 1)), None):
        with pytest.raises(UserError, match="FaultyVector.step returned an observation"):
            collect(FaultyVector({0: wrong}))
    for wrong in (1.0, np.ones(1), np.ones((2, 1)), np.array(["1", "2"]), None):
        with pytest.raises(UserError, match="FaultyVector.step returned rewards of shape"):
            collect(FaultyVector({1: wrong}))
    for wrong in (False, np.array(["False", "False"]), np.array([0.5, 0.5]), None):
        with pytest.raises(UserError, match="FaultyVector.step returned terminations of shape"):
            collect(FaultyVector({2: wrong}))


class FaultyTorch(EnvBase):
    def __init__(self, wrong: dict[str, torch.Tensor]) -> None:
        super().__init__(batch_size=[2])
        self.observation_spec = Composite(observation=Unbounded((2, 3)), shape=(2,))
        self.action_spec, self.reward_spec = Bounded(-1, 1, (2, 1)), Unbounded((2, 1))
        self.wrong, self.steps = wrong, 0

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        return TensorDict({"observation": torch.zeros(2, 3)}, [2])

    def _step(self, tensordict: Any) -> TensorDict:
        self.steps += 1
        flag = torch.zeros(2, 1, dtype=torch.bool)
        result = {
            "observation": torch.zeros(2, 3),
            "reward": torch.ones(2, 1),
            "done": flag,
            "terminated": flag.clone(),
        }
        return TensorDict(result | (self.wrong if self.steps > 3 else {}), [2])

    def _set_seed(self, seed: int | None) -> None: ...


@pytest.mark.fault(
    kind=1,
    injected="a TorchRL environment whose observation is [N, 1] or [N] later, or whose flags are floats",
    outcome="one line names the environment, the entry and the shape of its spec",
)
def test_torch_environments():
    for wrong in (torch.ones(2, 1), torch.ones(2), torch.ones(2, 3, 1)):
        with pytest.raises(UserError, match=r"FaultyTorch gave 'observation' of shape .*, its spec says \(2, 3\)"):
            collect(FaultyTorch({"observation": wrong}), num_envs=2)
    with pytest.raises(UserError, match="FaultyTorch gave 'done' of shape .*its spec says bool"):
        collect(FaultyTorch({"done": torch.zeros(2, 1)}), num_envs=2)


class FaultyTeam:
    """PettingZoo's parallel API."""

    possible_agents = ("a_0", "a_1")

    def __init__(self, wrong: dict[Any, Any]) -> None:
        self.wrong, self.steps, self.episodes = wrong, 0, 0

    def observation_space(self, agent: str) -> gym.Space:
        return VECTOR

    def action_space(self, agent: str) -> gym.Space:
        return spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.t, self.episodes = list(self.possible_agents), 0, self.episodes + 1
        return self._each(self.wrong.get("reset", ONES) if self.episodes > 2 else ONES), self._each({})

    def step(self, actions: Any) -> Any:
        self.t, self.steps = self.t + 1, self.steps + 1
        result = [self._each(x) for x in (ONES, 1.0, self.t == 10, False, {})]
        for place, x in (self.wrong if self.steps >= 5 else {}).items():
            if place != "reset":
                result[place] = x if isinstance(x, dict) else self._each(x)
        self.agents = [] if self.t == 10 else self.agents
        return tuple(result)

    def _each(self, x: Any) -> dict[str, Any]:
        return {agent: x for agent in self.possible_agents}


def collect_team(wrong: dict[Any, Any]) -> Any:
    return collect(partial(FaultyTeam, wrong))


@pytest.mark.fault(
    kind=1,
    injected="a PettingZoo environment with other shapes and types, or with no entry for an agent that acted",
    outcome="one line names the environment and the agent",
)
def test_teams():
    assert collect_team({})["next", "agents", "reward"].eq(1).all()
    for wrong in (ONES[:1], None, "x"):
        with pytest.raises(UserError, match="FaultyTeam.step returned an observation"):
            collect_team({0: wrong})
        with pytest.raises(UserError, match="FaultyTeam.reset returned an observation"):
            collect_team({"reset": wrong})
    for wrong in ("5", None, np.ones(1)):
        with pytest.raises(UserError, match="FaultyTeam.step returned a reward"):
            collect_team({1: wrong})
    for wrong in ("False", None):
        with pytest.raises(UserError, match="FaultyTeam.step returned terminated="):
            collect_team({2: wrong})
    for place, what in enumerate(("observations", "rewards", "terminations", "truncations")):
        with pytest.raises(UserError, match=f"returned no {what} of agent 'a_1', which acted"):
            collect_team({place: {"a_0": ONES if place == 0 else 0}})


class Halves(Faulty):
    """Changes its action in place, and returns an array that it changes later."""

    def step(self, action: Any) -> Any:
        action *= 0.5
        self.kept = getattr(self, "kept", np.zeros(3, np.float32))
        self.kept += action
        return (self.kept, *super().step(action)[1:])


class HalvesTeam(FaultyTeam):
    def step(self, actions: Any) -> Any:
        for action in actions.values():
            action *= 0.5
        mean = np.mean(list(actions.values()))
        return ({agent: mean * ONES for agent in actions}, *super().step(actions)[1:])


@pytest.mark.fault(
    kind=4,
    injected="an environment that halves its action in place and reuses its observation array",
    outcome="rollouts keep what was true, and a resume replays the episode bit for bit",
)
@pytest.mark.parametrize("made", [partial(Halves, {}), partial(HalvesTeam, {})])
def test_arrays_that_the_environment_changes(made: Any):
    def collector() -> collectors.VectorCollector:
        torch.manual_seed(0)
        env = envs.make(made, num_envs=2)
        return collectors.VectorCollector(env, modules.gaussian_actor(env, (4,)), frames_per_batch=14, compile="off")

    once, again = collector(), collector()
    first = once.rollout()
    state, expected = once.state_dict(), once.rollout()
    again.load_state_dict(state)
    assert (again.rollout() == expected).all()
    observed = first["next", "observation"] if made.func is Halves else first["next", "agents", "observation"]
    assert observed[:, 1:].ne(observed[:, :-1]).any()


@pytest.mark.fault(
    kind=5,
    injected="seeds up to 2^62, for single environments and for vectors",
    outcome="every seed that an environment gets fits a signed 32-bit integer",
)
def test_seeds_fit_31_bits():
    for seed in (0, 3, 2**31 - 1, 2**31, 2**62 - 1):
        made: list[Any] = []

        def one(made: list[Any] = made) -> gym.Env:
            made.append(Faulty())
            return made[-1]

        collect(one, steps=100, seed=seed)
        vector = SyncVectorEnv([one, one])
        collect(vector, seed=seed)
        seeds = [x for env in made for x in env.seeds if x is not None]
        assert len(seeds) > 20 and min(seeds) >= 0 and max(seeds) < 2**31


@pytest.mark.fault(
    kind=5,
    injected="an environment whose curriculum counts on one stream of random numbers, `reseed=False`",
    outcome="it is seeded once; a resume begins new episodes with another seed, and says so",
)
def test_without_reseeding_an_environment_is_seeded_once():
    made: list[Any] = []

    def one() -> gym.Env:
        made.append(Faulty())
        return made[-1]

    env = envs.make(one, num_envs=2, reseed=False)
    collector = collectors.VectorCollector(env, modules.gaussian_actor(env, (4,)), frames_per_batch=80, compile="off")
    collector.rollout()
    assert [len(x.seeds) for x in made] == [5, 5] and all(x.seeds[1:] == [None] * 4 for x in made)
    assert env.resume == "new episodes"
    before, state = [x.seeds[0] for x in made], collector.state_dict()
    collector.load_state_dict(state)
    assert all(x.seeds[-1] is not None and x.seeds[-1] not in before for x in made)
    with pytest.raises(UserError, match="reseed=False: SyncVectorEnv is seeded once anyway"):
        envs.make(SyncVectorEnv([Faulty]), reseed=False)


@pytest.mark.fault(
    kind=6,
    injected="`reset(options=...)` of the vector, and options for every reset",
    outcome="the first is refused in one line that names `reset_options=`, which reaches every reset",
)
def test_reset_options():
    made: list[Any] = []

    def one() -> gym.Env:
        made.append(Faulty())
        return made[-1]

    with pytest.raises(UserError, match=r"reset\(options=...\): the environments take a seed only.*reset_options="):
        envs.make(one).reset(options={"level": 1})
    made.clear()
    collect(one, reset_options={"level": 2})
    assert all(env.options == [{"level": 2}] * 5 for env in made)
    made.clear()
    collect(SyncVectorEnv([one]), num_envs=1, reset_options={"level": 2})
    assert made[0].options[0] == {"level": 2}
    assert (
        envs.make(Faulty, num_envs=2, seed=3)
        .reset()["observation"]
        .equal(envs.make(Faulty, num_envs=2).reset(seed=3)["observation"])
    )
    with pytest.raises(UserError, match="reset_options= is for single Gymnasium environments"):
        envs.make(FaultyTorch({}), reset_options={"level": 1})


class Informs(Faulty):
    def step(self, action: Any) -> Any:
        *rest, _ = super().step(action)
        return (*rest, {"is_success": rest[2], "speed": np.float64(self.t), "words": "fast", "three": ONES})


@pytest.mark.fault(
    kind=6,
    injected="entries of `info` by name: `is_success`, `episode`, any number; text and arrays without a spec",
    outcome="numbers reach rollout and log; anything else is refused in one line that names the entry",
)
def test_info_reaches_the_rollout():
    made = partial(gym.wrappers.RecordEpisodeStatistics, Informs())
    rollout = collect(lambda: gym.wrappers.RecordEpisodeStatistics(Informs()), info=("is_success", "speed", "episode"))
    assert made is not None and rollout["next", "is_success"].equal(rollout["next", "done"].float())
    assert rollout["next", "speed"][0, :10, 0].tolist() == list(range(1, 11))
    ends = rollout["next", "done"]
    assert rollout["next", "episode", "r"][ends].eq(10).all() and rollout["next", "episode", "l"][ends].eq(10).all()
    assert collect(Informs, info="speed")["next", "speed"].max() == 10
    assert collect(Informs, info={"three": Unbounded((3,))})["next", "three"].eq(1).all()
    for name in ("words", "three"):
        with pytest.raises(UserError, match=f"info='{name}' is .*: name entries that are single numbers"):
            collect(Informs, info=(name,))
    with pytest.raises(UserError, match="info='reward': rollouts have an entry of that name"):
        collect(Informs, info=("reward",))


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture):
    once.warn_once.cache_clear()
    caplog.set_level(logging.INFO, "pgkit")
    yield caplog
    once.warn_once.cache_clear()


@pytest.mark.fault(
    kind=7,
    injected="wrappers with statistics of their own, of single environments, of vectors and of TorchRL",
    outcome="one warning, however many environments, that names `--normalize-obs` and `--scale-returns`",
)
@pytest.mark.filterwarnings("ignore:Support of VecNormV2")
def test_stateful_wrappers_are_named_once(said: pytest.LogCaptureFixture):
    from torchrl.envs import TransformedEnv, VecNormV2

    for made in (
        lambda: gym.wrappers.TimeLimit(gym.wrappers.NormalizeObservation(Faulty()), 5),
        lambda: gym.wrappers.NormalizeReward(Faulty()),
        lambda num_envs: gym.wrappers.vector.NormalizeObservation(SyncVectorEnv([Faulty] * num_envs)),
        lambda: TransformedEnv(FaultyTorch({}), VecNormV2(in_keys=["observation"])),
    ):
        said.clear()
        once.warn_once.cache_clear()
        for seed in (0, 1):
            envs.make(made, num_envs=2, seed=seed)
        assert said.text.count("keeps statistics that evaluation and a resume begin anew: use --normalize-obs") == 1


class Foreign(gym.Space):
    """A space of another library, such as MiniGrid's mission."""

    def __init__(self) -> None:
        super().__init__((), str)

    def sample(self, mask: Any = None, probability: Any = None) -> Any:
        return "go"


def of_space(space: Any) -> type[Faulty]:
    return type("Spaced", (Faulty,), {"observation_space": space})


IMAGE = spaces.Box(0, 255, (7, 7, 3), np.uint8)


@pytest.mark.fault(
    kind=8,
    injected="entries without numbers: text, sequences, graphs, another library's spaces, nested ones",
    outcome="left out with a warning that names them; a space of nothing else is refused in one line",
)
def test_entries_without_numbers_are_left_out(said: pytest.LogCaptureFixture):
    space = spaces.Dict(
        v=VECTOR, d=spaces.Discrete(4), mission=Foreign(), words=spaces.Text(9),
        inner=spaces.Dict(w=VECTOR, many=spaces.Sequence(VECTOR)), net=spaces.Graph(VECTOR, None),
    )  # fmt: skip
    assert collect(of_space(space))["observation"].shape[2:] == (10,)
    for name in ("mission", "words", "inner.many", "net"):
        assert said.text.count(f"the observation's entry '{name}' holds no numbers and is left out") == 1
    assert set(envs.make(of_space(space), flatten=False).observation_spec.keys()) == {"v", "d", "inner"}
    for nothing in (Foreign(), spaces.Dict(), spaces.Dict(a=spaces.Text(3)), spaces.Sequence(VECTOR)):
        with pytest.raises(UserError, match="holds no numbers and cannot become one vector: encode it in a wrapper"):
            envs.make(of_space(nothing))


def test_flat_observations_are_gymnasiums():
    space = spaces.Dict(
        b=spaces.MultiDiscrete([2, 3], start=[1, 4]), a=spaces.Discrete(3, start=-1), c=spaces.MultiBinary((2, 2)),
        d=spaces.Tuple((VECTOR, spaces.Dict(x=spaces.Box(-1, 1, (2, 2))))), e=spaces.MultiDiscrete([[2, 3]]),
    )  # fmt: skip
    space.seed(0)
    from pgkit.envs.spaces import observation_entries

    (entry,) = observation_entries(space)
    for _ in range(20):
        obs = space.sample()
        np.testing.assert_array_equal(entry.read(obs), spaces.flatten(space, obs))
    assert entry.shape == (spaces.flatdim(space),)


@pytest.mark.fault(
    kind=8,
    injected="an image inside a Dict, nested, or as floats",
    outcome="flattened only with a warning that names it and says how to keep it apart",
)
def test_an_image_inside_a_dict_is_not_flattened_silently(said: pytest.LogCaptureFixture):
    envs.make(of_space(spaces.Dict(v=VECTOR, image=IMAGE, inner=spaces.Dict(eye=IMAGE))))
    envs.make(of_space(spaces.Dict(v=VECTOR, floats=spaces.Box(0, 1, (8, 8, 3), np.float32))))
    for name in ("image", "inner.eye", "floats"):
        assert f"image '{name}' is flattened with the rest: envs.make(..., flatten=False) keeps it apart" in said.text


@pytest.mark.fault(
    kind=8,
    injected="small matrices (5, 5), of floats and of bytes",
    outcome="they keep their shape in the rollout, and networks flatten them",
)
@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_small_matrices_are_flattened_by_the_networks(dtype: Any):
    env = envs.make(of_space(spaces.Box(0, 1 if dtype == np.float32 else 255, (5, 5), dtype)), num_envs=2)
    obs = env.reset()["observation"]
    for net in (modules.state_value(env, (4,)), modules.q_value(env, 2, (4,)), modules.gaussian_actor(env, (4,))):
        data = TensorDict({"observation": obs, "action": torch.zeros(2, 1)}, [2])
        assert net(data) is not None
    net = modules.state_value(env, ())
    linear = next(x for x in net.modules() if isinstance(x, torch.nn.Linear))
    expected = obs.double().flatten(1) @ linear.weight.double().T + linear.bias.double()
    torch.testing.assert_close(net(TensorDict({"observation": obs}, [2]))["state_value"], expected.float())


@pytest.mark.fault(
    kind=8,
    injected="spaces of the old gym, None, or none at all; an EnvSpec; a `make_vec` result",
    outcome="the first three are refused in one line; an EnvSpec and a vector are taken",
)
def test_other_ways_to_name_an_environment():
    old = type("Box", (), {"__module__": "gym.spaces.box"})()
    for name in ("observation_space", "action_space"):
        for wrong in (old, None, 5, VECTOR.shape):
            with pytest.raises(UserError, match=f"Spaced.{name} is .*no gymnasium.spaces.Space"):
                envs.make(type("Spaced", (Faulty,), {name: wrong}))
    with pytest.raises(UserError, match="Bare.observation_space is missing"):
        envs.make(type("Bare", (gym.Env,), {}))
    for space in (Foreign(), spaces.Dict(a=VECTOR), spaces.Text(3)):
        with pytest.raises(UserError, match="action space .* is not supported"):
            envs.make(type("Spaced", (Faulty,), {"action_space": space}))
    spec = copy.deepcopy(gym.spec("Pendulum-v1"))  # gym.spec gives the registry's own
    spec.kwargs["g"], spec.max_episode_steps = 3.0, 7
    env = envs.make(spec, num_envs=2)
    assert [x.unwrapped.g for x in env.simulator.envs] == [3.0, 3.0] and env.env_id == "Pendulum-v1"
    assert collect(spec, steps=14)["next", "truncated"].sum() == 4
    spec.entry_point = "somewhere:Else"
    with pytest.raises(UserError, match=r"the EnvSpec of 'Pendulum-v1' is not the registered one: .*lambda: spec.make"):
        envs.make(spec)
    assert collect(gym.make_vec("Pendulum-v1", num_envs=2))["action"].shape == (2, 40, 1)
