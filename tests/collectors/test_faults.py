"""Environments that raise, exit or hang, and processes that end: named, survived, and nothing left behind."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from pgkit import collectors, envs, modules
from pgkit.collectors.workers import WorkerEnded
from pgkit.envs import gym_list
from pgkit.envs.seeding import episode_seed
from pgkit.errors import EnvironmentFailed, EnvironmentHung, UserError
from tests.faulty import Faulty


class Second:
    """Makes environments of which the second is faulty."""

    def __init__(self, *settings: Any) -> None:
        self.settings = settings

    def __call__(self, seed: int) -> gym.Env:
        return Faulty(*self.settings) if seed == episode_seed(3, 1, 0) else Faulty()


def make(*faults: Any, workers: int = 1, num_envs: int = 4, kind: Any = None, core: Any = None, **settings: Any) -> Any:
    """A collector of rollouts of 4 steps of each environment; ``faults`` are the second one's."""
    torch.manual_seed(0)
    env = envs.make(Second(*faults), num_envs, seed=3, workers=workers, **settings)
    actor = modules.gaussian_actor(env, **({} if core is None else {"encoder": core(env, 4, hidden=(4,))}))
    kind = kind or collectors.VectorCollector
    return kind(env, actor, frames_per_batch=4 * num_envs, compile="off")


def equal(a: Any, b: Any) -> bool:
    return set(a.keys(True, True)) == set(b.keys(True, True)) and bool((a == b).all())


@pytest.mark.fault(kind=22, injected="an exception in an environment", outcome="environment, index, step, seed named")
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    ("deed", "step", "message"),
    [
        ("raise", 3, r"step 3 of the episode of reset\(seed=(\d+)\): IndexError: list index out of range"),
        ("raise", 0, r"reset\(seed=(\d+)\): IndexError: list index out of range"),
        ("sys.exit", 3, r"step 3 of the episode of reset\(seed=(\d+)\): it called sys.exit\(0\)"),
    ],
)
def test_an_error_names_the_environment_its_step_and_its_seed(workers: int, deed: str, step: int, message: str):
    collector = make(deed, step, workers=workers)
    collector.rollout()
    with pytest.raises(EnvironmentFailed, match=r"^environment 1 \(Faulty\), " + message) as raised:
        collector.rollout()
    assert f"seed={episode_seed(3, 1, 1)}" in raised.value.line
    assert "tests/faulty.py" in raised.value.frames and "pgkit/envs" not in raised.value.frames
    state, again = collector.state_dict(), make(workers=3 - workers)
    again.load_state_dict(state)
    assert state["frames"] == again.frames == 16
    first = again.rollout()["observation"][:, 0]  # everywhere a new episode, other than the first two
    drawn = [[np.random.default_rng(episode_seed(3, i, e)).uniform() for e in (0, 1, 2)] for i in range(4)]
    assert (first[:, 0] == 0).all() and not np.isclose(np.array(drawn), first[:, 1:].numpy()).any()
    again.shutdown()


def test_an_environment_that_is_seeded_once_fails_in_an_episode_without_a_seed():
    class Third(gym.Env):
        """Its first episode has two steps; the next step fails."""

        observation_space, action_space, steps = gym.spaces.Box(-1, 1, (1,)), gym.spaces.Discrete(2), 0

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return np.zeros(1, np.float32), {}

        def step(self, action: Any) -> Any:
            self.steps += 1
            assert self.steps < 3, "no more"
            return np.zeros(1, np.float32), 0.0, self.steps == 2, False, {}

    env = envs.make(Third, reseed=False)
    collector = collectors.VectorCollector(env, modules.categorical_actor(env), frames_per_batch=4, compile="off")
    with pytest.raises(EnvironmentFailed, match=r"step 1 of the episode of reset\(seed=None\)"):
        collector.rollout()


def test_a_vector_that_fails_names_what_it_knows():
    env = envs.make(lambda: gym.make_vec("CartPole-v1", num_envs=3), 3, seed=1)
    env.simulator.env.step = lambda actions: 1 / 0
    collector = collectors.VectorCollector(env, modules.categorical_actor(env), frames_per_batch=3, compile="off")
    with pytest.raises(
        EnvironmentFailed, match=r"^environments 0 to 2 \(CartPoleVectorEnv, seed 1\), step 1 since the start"
    ):
        collector.rollout()


@pytest.mark.fault(
    kind=22, injected="os._exit(0) or SIGKILL in a worker", outcome="no success: one line with its cause"
)
@pytest.mark.parametrize(("deed", "how"), [("os._exit", "exit code 0: .*os._exit"), ("kill", "SIGKILL .out of memory")])
def test_a_worker_that_ends_is_named(deed: str, how: str):
    collector = make(deed, 3, workers=2)
    collector.rollout()
    worker = r"collector worker 0 \(environments 0 to 1 of Second, seed 3\), in the rollout from step 4 on, "
    with pytest.raises(WorkerEnded, match=worker + f".*{how}"):
        collector.rollout()
    assert not any(process.is_alive() for process in collector._workers._processes)
    after = collector.rollout()  # new processes, new episodes
    assert (after["observation"][:, 0, 0] == 0).all() and collector.frames == 32
    collector.shutdown()


@pytest.mark.fault(
    kind=21, injected="SIGTERM, SIGHUP, SIGINT to the worker processes", outcome="not heard: the parent's to handle"
)
@pytest.mark.fault(
    kind=24, injected="SIGKILL of a worker, --restart-workers", outcome="replaced; the same numbers, bit for bit"
)
@pytest.mark.parametrize("kind", [collectors.VectorCollector, collectors.AsyncCollector])
def test_a_worker_that_is_killed_is_replaced_and_the_numbers_stay(tmp_path: Path, kind: Any, caplog: Any):
    undisturbed = make(core=modules.gru, kind=kind, workers=2)
    expected = [undisturbed.rollout() for _ in range(5)]
    undisturbed.shutdown()
    for deed in ("kill", "os._exit"):
        collector = make(deed, 3, 2, tmp_path / deed, workers=2, core=modules.gru, kind=kind, restart_workers=True)
        found = [collector.rollout() for _ in range(2)]
        pool = collector._workers if kind is collectors.VectorCollector else collector._groups[0]
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            for process in pool._processes:
                os.kill(process.pid, number)
        found.append(collector.rollout())
        os.kill(pool._processes[1].pid, signal.SIGKILL)  # between two rollouts, or beside the update
        found += [collector.rollout() for _ in range(2)]
        assert all(equal(a, b) for a, b in zip(expected, found, strict=True)), deed
        assert pool.episodes_lost == 0
        collector.shutdown()
        assert caplog.text.count("a new process takes its place: its environments go on where they were") == 2
        caplog.clear()


@pytest.mark.fault(
    kind=24, injected="a worker that ends at the same step each time", outcome="new episodes, counted; then one line"
)
def test_a_worker_that_ends_again_begins_new_episodes_and_then_is_an_error(caplog: Any):
    collector = make("kill", 3, 2, workers=2, restart_workers=True)
    first = collector.rollout()
    second = collector.rollout()  # episode 1 kills it, and again when it is replayed; then come other episodes
    assert collector._workers.episodes_lost == 2
    assert "begin new episodes (2 lost so far)" in caplog.text
    assert (second["observation"][:2, 0, 0] == 0).all() and (second["observation"][2:, 0, 0] == 4).all()
    assert first["observation"][0, 0, 1] != second["observation"][0, 0, 1]
    collector.shutdown()
    collector = make("kill", 1, 1, workers=2, restart_workers=True)  # in the first episode of any process
    with pytest.raises(WorkerEnded, match="SIGKILL"):
        collector.rollout()


@pytest.mark.fault(kind=23, injected="an environment that hangs, --env-timeout", outcome="named; one line")
@pytest.mark.parametrize("workers", [1, 2])
def test_an_environment_that_hangs_is_named(workers: int):
    collector = make("sleep", 3, workers=workers, env_timeout=0.5)
    collector.rollout()
    with pytest.raises(
        EnvironmentHung, match=r"^environment 1 \(Faulty\), step 3 of .*: it takes longer than 0.5 s"
    ) as raised:
        collector.rollout()
    assert "time.sleep(1000)" in raised.value.frames


@pytest.mark.fault(kind=23, injected="a worker that is stopped or hangs, --env-timeout", outcome="named, or replaced")
def test_a_worker_that_hangs_is_named_or_replaced(tmp_path: Path, caplog: Any):
    undisturbed = make(workers=2)
    expected = [undisturbed.rollout() for _ in range(3)]
    undisturbed.shutdown()
    with pytest.raises(WorkerEnded, match=r"collector worker 0 .* has made no step for 1 s \(--env-timeout 0.5\)"):
        collector = make("stop", 3, workers=2, env_timeout=0.5)
        for _ in range(2):
            collector.rollout()
    assert not any(process.is_alive() for process in collector._workers._processes)
    for deed in ("stop", "sleep"):
        collector = make(deed, 3, 2, tmp_path / deed, workers=2, env_timeout=0.5, restart_workers=True)
        assert all(equal(a, collector.rollout()) for a in expected), deed
        assert "its environments go on where they were" in caplog.text
        caplog.clear()
        collector.shutdown()


SLEEPER = """
import os, signal, time
import gymnasium as gym
import numpy as np
from pgkit import collectors, envs, modules

class Sleeper(gym.Env):
    observation_space, action_space = gym.spaces.Box(-1, 1, (1,)), gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        os.write(1, f"{os.getpid()}\\n".encode())  # at once: two processes print here
        while True:
            time.sleep(0.01)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background jobs ignore
    env = envs.make(Sleeper, 2, workers=2)
    collectors.VectorCollector(env, modules.gaussian_actor(env), frames_per_batch=2, compile="off").rollout()
"""


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.fault(
    kind=23,
    injected="SIGKILL of the run while workers are inside env.step",
    outcome="workers end; nothing left in /dev/shm, /tmp",
)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_the_workers_end_with_their_parent(tmp_path: Path, number: signal.Signals):
    script, temporary, shared = tmp_path / "sleeper.py", tmp_path / "tmp", set(os.listdir("/dev/shm"))
    script.write_text(SLEEPER)
    temporary.mkdir()
    settings = {**os.environ, "TMPDIR": str(temporary), "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=settings
    ) as run:
        assert run.stdout
        try:
            pids = [int(run.stdout.readline()) for _ in range(2)]
            run.send_signal(number)
            end = time.monotonic() + 30
            while not all(map(gone, pids)) and time.monotonic() < end:
                time.sleep(0.05)
            assert all(map(gone, pids))
        except BaseException:
            run.kill()
            raise
        while list(temporary.iterdir()) and time.monotonic() < end:  # the last of them removes it
            time.sleep(0.05)
    left = set(os.listdir("/dev/shm")) - shared
    while left and time.monotonic() < end:  # other tests' come and go
        left &= set(os.listdir("/dev/shm"))
        time.sleep(0.05)
    assert not list(temporary.iterdir()) and not left


@pytest.mark.fault(
    kind=12,
    injected="an episode without end",
    outcome="its history is bounded, one warning; a resume begins the next episode",
)
def test_the_history_of_an_endless_episode_is_bounded(monkeypatch: pytest.MonkeyPatch, caplog: Any):
    monkeypatch.setattr(gym_list, "LONGEST", 10)
    env = envs.make(lambda seed: Faulty(length=10**9 if seed == episode_seed(3, 1, 0) else 7), 2, seed=3)
    simulator, moves = env.simulator, np.random.default_rng(0).uniform(-1, 1, (40, 2, 1)).astype(np.float32)
    simulator.reset()
    for number, move in enumerate(moves, 1):
        simulator.step({"action": torch.from_numpy(move)})
        assert len(simulator._taken) <= 10, number
    assert caplog.text.count("its actions are kept no longer, a resume begins a new one") == 1
    assert "episode of environment 1 (Faulty)" in caplog.text
    state = simulator.state_dict()
    assert [row["episode"] for row in state["rows"]] == [5, 1] and len(state["rows"][0]["actions"]) == 5
    again = envs.make(lambda: Faulty(length=7), 2, seed=3).simulator
    fresh = again.load_state_dict(state)["observation"]
    assert fresh[0].tolist() == simulator._fresh.tensors["observation"][0].tolist() and fresh[1, 0] == 0
    assert fresh[1, 1] == pytest.approx(np.random.default_rng(episode_seed(3, 1, 1)).uniform())


@pytest.mark.fault(kind=20, injected="too few open files for workers (ulimit -n)", outcome="one line")
@pytest.mark.parametrize("spare", [1, 8, 18])
def test_too_few_files_for_workers_is_one_line(spare: int):
    collector = make(workers=2)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + spare, hard))
    try:
        with pytest.raises(
            UserError, match=r"(worker processes cannot be started|need shared memory): .*oo many open f"
        ):
            collector.rollout()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_an_address_of_a_cluster_that_is_none_is_one_line():
    with pytest.raises(UserError, match="--ray-address nonsense: give auto, HOST:6379"):
        collectors.connect("nonsense")
