"""How many threads a run takes, and how they wait."""

import json
import os
import subprocess
import sys

import pytest
import torch

from pgkit.cli.main import main
from pgkit.compiled import products
from pgkit.run import run, threads
from tests.recipes.test_ppo import pgkit


@pytest.mark.parametrize(("two", "chosen"), [(0.5, 2), (0.7, 2), (0.75, 1), (1.0, 1), (30.0, 1)])
def test_two_threads_where_they_are_much_faster_now(monkeypatch, caplog, two, chosen):
    caplog.set_level("INFO", "pgkit")
    monkeypatch.setattr(threads, "_cores", lambda: 2)
    assert threads.fastest_threads({1: 1.0, 2: two}.__getitem__) == chosen
    assert f"--threads {chosen}: a product 256 wide is {1 / two:.1f} times as fast" in caplog.text


def test_one_busy_moment_does_not_decide(monkeypatch):
    monkeypatch.setattr(threads, "_cores", lambda: 2)
    slow_once = iter([1.0, 9.0, *[1.0, 0.5] * 4])
    assert threads.fastest_threads(lambda _: next(slow_once)) == 2


def test_one_core_is_one_thread_and_torchs_threads_stay(monkeypatch):
    before = torch.get_num_threads()
    assert threads.fastest_threads() in (1, 2) and torch.get_num_threads() == before
    monkeypatch.setattr(threads, "_cores", lambda: 1)
    assert threads.fastest_threads(lambda count: 1 / count) == 1


def test_a_machine_is_measured_once_and_a_run_keeps_it(monkeypatch, tmp_path):
    flags = ["--env-id", "CartPole-v1", "--num-envs", 2, "--steps", 32, "--eval-episodes", 1, "--threads", 0]
    monkeypatch.setattr(products, "_choices", {})
    monkeypatch.setattr(products, "_file", lambda: tmp_path / "choices.json")
    monkeypatch.setattr(run, "fastest_threads", lambda: 1)
    pgkit("run", "a2c", *flags, "--total-frames", 64, "--run-dir", tmp_path / "run")
    assert json.loads((tmp_path / "run" / "config.json").read_text())["settings"]["threads"] == 1
    monkeypatch.setattr(run, "fastest_threads", lambda: pytest.fail("measured again"))
    pgkit("run", "a2c", "--resume", tmp_path / "run", "--total-frames", 128)
    monkeypatch.setattr(products, "_choices", {})  # another process: the same seed gives the same numbers
    pgkit("run", "a2c", *flags, "--total-frames", 64, "--run-dir", tmp_path / "again")


def test_the_command_line_lets_waiting_threads_sleep_unless_told_otherwise(monkeypatch):
    for name in ("GOMP_SPINCOUNT", "KMP_BLOCKTIME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    main(["ls"])
    assert os.environ["OMP_WAIT_POLICY"] == "active"
    monkeypatch.delenv("OMP_WAIT_POLICY")
    main(["ls"])
    assert os.environ["OMP_WAIT_POLICY"] == "passive"
    done = subprocess.run([sys.executable, "-c", "import pgkit.cli.main, sys; assert 'torch' not in sys.modules"])
    assert done.returncode == 0  # torch reads it when it loads
