"""A policy that left: ONNX Runtime, torch.export and a folder act as it does, in another process too."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import onnxruntime
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import DistributionalQValueActor, QValueActor

from pgkit import envs, modules, run
from pgkit.cli.main import main
from pgkit.errors import UserError
from pgkit.run.exported import Acts, example

Box, Discrete = gym.spaces.Box, gym.spaces.Discrete


def env_of(observation: gym.Space, action: gym.Space, **kwargs: Any) -> Any:
    """An environment with these spaces that nobody steps."""

    class Still(gym.Env):
        observation_space, action_space = observation, action

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return self.observation_space.sample(), {}

    return envs.make(Still, **kwargs)


class Team(EnvBase):
    """Three agents with observations of 4 numbers and actions of 2, which nobody steps."""

    def __init__(self) -> None:
        super().__init__(batch_size=[2])
        obs, action = Unbounded((2, 3, 4)), Bounded(-1.0, 1.0, (2, 3, 2))
        self.observation_spec = Composite(agents=Composite(observation=obs, shape=(2, 3)), shape=(2,))
        self.action_spec = Composite(agents=Composite(action=action, shape=(2, 3)), shape=(2,))
        self.reward_spec = Composite(agents=Composite(reward=Unbounded((2, 3, 1)), shape=(2, 3)), shape=(2,))

    def _reset(self, tensordict: Any = None, **_: Any) -> Any:
        return self.observation_spec.zero()

    def _step(self, tensordict: Any) -> Any: ...

    def _set_seed(self, seed: int | None) -> None: ...


VECTOR, BOUNDED = Box(-9, 9, (3,), np.float32), Box(np.float32([-2, 0]), np.float32([1, 5]))
MASKED = gym.spaces.Dict(observation=VECTOR, action_mask=gym.spaces.MultiBinary(4))
PARTS = gym.spaces.Dict(place=VECTOR, image=Box(0, 255, (3, 36, 36), np.uint8))
IMAGE = Box(0, 255, (3, 36, 36), np.uint8)


def normalized(env: Any) -> modules.ObsNormalizer:
    """A normalizer that has seen something."""
    normalizer = modules.ObsNormalizer(env)
    normalizer.update(torch.randn(50, *env.observation_spec["observation"].shape[1:]) * 3 + 1)
    return normalizer


def dict_actor(env: Any) -> Any:
    parts = {"place": torch.nn.Linear(3, 8), "image": modules.conv_encoder(env, key="image")}
    return modules.gaussian_actor(env, encoder=modules.dict_encoder(parts))


def q_actor(env: Any) -> Any:
    return QValueActor(modules.mlp(3, 4, (16,)), in_keys=["observation"], action_space="categorical")


def c51_actor(env: Any) -> Any:
    net = torch.nn.Sequential(torch.nn.Linear(3, 4 * 11), torch.nn.Unflatten(-1, (11, 4)), torch.nn.LogSoftmax(-2))
    return DistributionalQValueActor(
        net, in_keys=["observation"], support=torch.linspace(0, 1, 11), action_space="categorical"
    )


KINDS: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
    "gaussian": (lambda: env_of(VECTOR, BOUNDED), lambda e: modules.gaussian_actor(e, normalizer=normalized(e))),
    "tanh": (lambda: env_of(VECTOR, BOUNDED), lambda e: modules.tanh_normal_actor(e, normalizer=normalized(e))),
    "deterministic": (lambda: env_of(VECTOR, BOUNDED), modules.deterministic_actor),
    "categorical": (lambda: env_of(VECTOR, Discrete(4, start=5)), modules.categorical_actor),
    "several choices": (lambda: env_of(VECTOR, gym.spaces.MultiDiscrete([2, 5])), modules.categorical_actor),
    "masked": (lambda: env_of(MASKED, Discrete(4), flatten=False), modules.categorical_actor),
    "q-values": (lambda: env_of(VECTOR, Discrete(4)), q_actor),
    "distributional q-values": (lambda: env_of(VECTOR, Discrete(4)), c51_actor),
    "gru": (lambda: env_of(VECTOR, BOUNDED), lambda e: modules.gaussian_actor(e, encoder=modules.gru(e, 8))),
    "lstm": (lambda: env_of(VECTOR, Discrete(4)), lambda e: modules.categorical_actor(e, encoder=modules.lstm(e, 8))),
    "dict": (lambda: env_of(PARTS, BOUNDED, flatten=False), dict_actor),
    "pixels": (
        lambda: env_of(IMAGE, Discrete(4)),
        lambda e: modules.categorical_actor(e, encoder=modules.conv_encoder(e)),
    ),
    "group": (lambda: envs.make(Team()), lambda e: modules.gaussian_actor(e)),
    "group with parameters of its own": (
        lambda: envs.make(Team()),
        lambda e: modules.tanh_normal_actor(e, share_parameters=False),
    ),
}


def policy_of(kind: str) -> run.Policy:
    torch.manual_seed(0)
    make, build = KINDS[kind]
    env = make()
    actor = build(env)
    for parameter in actor.parameters():  # far from the initial zeros, so that actions reach their bounds
        torch.nn.init.normal_(parameter, std=0.5)
    return run.Policy.of(actor.eval(), env)


def acts(policy: run.Policy, inputs: Any) -> tuple[torch.Tensor, ...]:
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        out = Acts(policy).eval()(*inputs)
    return out if isinstance(out, tuple) else (out,)


@pytest.mark.parametrize("kind", KINDS)
def test_onnx_runtime_acts_as_torch_does(kind: str, tmp_path: Path):
    policy = policy_of(kind)
    session = onnxruntime.InferenceSession(run.export(policy, tmp_path / "policy.onnx"))
    inputs = list(example(policy, rows=7))  # the graph was made with two
    for _ in range(2):
        wanted = acts(policy, inputs)
        named = {name: x.numpy() for name, x in zip(Acts(policy).names, inputs, strict=True)}
        found = session.run(None, named)
        assert len(found) == len(wanted) == (2 if policy.memory else 1)
        for x, y in zip(found, wanted, strict=True):
            assert x.dtype == y.numpy().dtype
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-5)
        if policy.memory:  # the second step goes on, but for the first row, where an episode begins
            inputs[-2:] = torch.arange(7).eq(0).unsqueeze(-1), torch.from_numpy(found[1])


def test_the_graph_gives_what_predict_gives(tmp_path: Path):
    for kind in ("gaussian", "categorical"):
        policy = policy_of(kind)
        session = onnxruntime.InferenceSession(run.export(policy, tmp_path / "policy.onnx"))
        obs = np.random.default_rng(0).normal(size=(50, 3)).astype("f4") * 5
        found, predicted = np.asarray(session.run(None, {"observation": obs})[0]), policy.predict(obs)
        np.testing.assert_allclose(found, predicted, rtol=0, atol=1e-5)
        if kind == "gaussian":  # some are clipped, to each dimension's own bound
            assert (found == np.float32([-2, 0])).any(0).all() and (found <= np.float32([1, 5])).all()
        else:
            assert set(found.tolist()) <= {5, 6, 7, 8}


def test_a_fresh_process_without_torch_or_pgkit(tmp_path: Path):
    policy = policy_of("gaussian")
    run.export(policy, tmp_path / "policy.onnx")
    obs = np.random.default_rng(0).normal(size=(5, 3)).astype("f4")
    np.save(tmp_path / "obs.npy", obs)
    code = (
        "import sys, numpy as np, onnxruntime\n"
        "s = onnxruntime.InferenceSession('policy.onnx')\n"
        "np.save('out.npy', s.run(None, {'observation': np.load('obs.npy')})[0])\n"
        "assert not {'torch', 'pgkit'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    np.testing.assert_allclose(np.load(tmp_path / "out.npy"), policy.predict(obs), rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", ["tanh", "masked", "gru"])
def test_torch_export_acts_as_torch_does(kind: str, tmp_path: Path):
    policy = policy_of(kind)
    module = torch.export.load(run.export(policy, tmp_path / "policy.pt2")).module()
    inputs = example(policy, rows=7)
    out = module(*inputs)
    for x, y in zip(out if isinstance(out, tuple) else (out,), acts(policy, inputs), strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=1e-6)


def test_what_cannot_be_exported(tmp_path: Path, kit: SimpleNamespace):
    decides = TensorDictModule(lambda x: x if x.sum() > 0 else -x, ["observation"], ["action"])
    policy = run.Policy(decides, lambda: None, (2,))
    with pytest.raises(UserError, match="torch.export cannot trace this policy"):
        run.export(policy, tmp_path / "policy.onnx")
    with pytest.raises(UserError, match="converts actions by its own <function clip"):
        run.export(run.Policy.of(kit.policy(), kit.Env(1, 0)), tmp_path / "policy.onnx")
    with pytest.raises(UserError, match="is written from a run"):
        run.export(policy, tmp_path / "folder")
    with pytest.raises(UserError, match="ends in .onnx or .pt2"):
        run.export(policy, tmp_path / "policy.tflite")
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trained") / "run"
    sizes = ["--total-frames", "512", "--num-envs", "4", "--steps", "64", "--eval-episodes", "1"]
    main(["run", "ppo", "--env-id", "Pendulum-v1", *sizes, "--compile", "off", "--run-dir", str(path)])
    return path


def test_a_folder_is_the_policy(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "policy"
    main(["export", str(trained), "--output", str(folder)])
    assert f"wrote {folder}" in capsys.readouterr().out
    obs = np.random.default_rng(0).normal(size=(9, 3)).astype("f4") * 3
    policy, other = run.load_policy(trained), run.load_policy(folder)
    np.testing.assert_array_equal(policy.predict(obs), other.predict(obs))
    assert other.frames == policy.frames == 512
    score = run.evaluate(other, other.make_env(num_envs=1, seed=3), 1)
    assert score == run.evaluate(policy, policy.make_env(num_envs=1, seed=3), 1)
    kept = [row for row in (trained / "metrics.csv").read_text().splitlines() if row.startswith("512,")]
    card = (folder / "README.md").read_text()
    assert "# ppo on Pendulum-v1" in card and "512 frames" in card and "| torch | 2." in card
    assert kept and any(f"{float(x):,.2f}" in card for x in kept[0].split(",") if x and float(x) < -100)
    for file in folder.iterdir():  # no path of this machine, and no pickle
        data = file.read_bytes()
        assert str(tmp_path.parent.parent).encode() not in data and b"\x80\x02" not in data[:4], file
    main(["export", str(trained), "--output", str(folder)])  # its own folder is replaced


def test_a_damaged_folder_is_one_line(trained: Path, tmp_path: Path):
    folder = run.export(run.load_policy(trained), tmp_path / "policy")
    (folder / "policy.safetensors").write_bytes(b"no tensors")
    with pytest.raises(UserError, match="policy.safetensors does not fit the policy"):
        run.load_policy(folder)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes").write_text("keep")
    with pytest.raises(UserError, match="holds something else"):
        run.export(run.load_policy(trained), tmp_path / "mine")


RECIPE = """
from dataclasses import dataclass
from pgkit import modules, run

@dataclass
class Args(run.RunArgs):
    width: int = 4

def agent(args: Args, env):
    return run.Agent(modules.gaussian_actor(env, hidden=(args.width,)))

def main(args):
    with run.Run(args, "mine") as log:
        env = args.make_env(1, 0)
        log.track(agent=agent(args, env), eval_env=args.make_env)
        log.step(args.total_frames)

if __name__ == "__main__":
    run.launch(main, Args)
"""


def test_a_recipe_of_ones_own_goes_along_and_runs_where_it_is_trusted(tmp_path: Path, monkeypatch: Any):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(RECIPE)
    flags = ["--env-id", "Pendulum-v1", "--total-frames", "5", "--eval-episodes", "1", "--run-dir", "r"]
    subprocess.run([sys.executable, "own.py", *flags], check=True, capture_output=True)
    policy = run.load_policy("r", trust=True)
    folder = run.export(policy, "policy")
    (tmp_path / "own.py").unlink()
    with pytest.raises(UserError, match="--trust"):
        run.load_policy(folder)
    obs = np.ones((2, 3), np.float32)
    np.testing.assert_array_equal(run.load_policy(folder, trust=True).predict(obs), policy.predict(obs))
    assert "trust=True" in (folder / "README.md").read_text()


class Hub:
    """What huggingface-hub's HfApi would be asked."""

    def __init__(self, problem: Exception | None = None) -> None:
        self.problem, self.asked = problem, []

    def create_repo(self, repo: str, **settings: Any) -> str:
        self.asked.append((repo, settings))
        return f"https://hub/{repo}"

    def upload_folder(self, **settings: Any) -> None:
        if self.problem:
            raise self.problem
        self.asked.append(settings)


def test_one_call_pushes_a_folder(trained: Path, tmp_path: Path):
    folder, hub = run.export(run.load_policy(trained), tmp_path / "policy"), Hub()
    assert run.push_to_hub(folder, "me/pendulum", api=hub) == "https://hub/me/pendulum"
    assert hub.asked[0] == ("me/pendulum", {"private": False, "exist_ok": True})
    assert hub.asked[1]["repo_id"] == "me/pendulum" and hub.asked[1]["folder_path"] == folder
    assert {file.name for file in folder.iterdir()} <= set(hub.asked[1]["allow_patterns"])
    with pytest.raises(UserError, match="the Hub does not take me/pendulum: offline"):
        run.push_to_hub(folder, "me/pendulum", api=Hub(OSError("offline")))
    with pytest.raises(UserError, match="is no policy folder"):
        run.push_to_hub(trained, "me/pendulum", api=hub)
    with pytest.raises(UserError, match="give user/name"):
        run.push_to_hub(folder, "pendulum", api=hub)


def test_the_command_line_writes_onnx(trained: Path, tmp_path: Path):
    main(["export", str(trained), "--output", str(tmp_path / "policy.onnx"), "--which", "latest"])
    obs = np.ones((3, 3), np.float32)
    found = onnxruntime.InferenceSession(tmp_path / "policy.onnx").run(None, {"observation": obs})[0]
    np.testing.assert_allclose(found, run.load_policy(trained, "latest").predict(obs), rtol=0, atol=1e-5)
