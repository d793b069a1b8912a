import json
from pathlib import Path

import numpy as np
import pytest

from pgkit import run
from pgkit.errors import UserError
from pgkit.run.plots import mean_and_band


def test_mean_and_band_are_taken_where_all_curves_have_values():
    frames, mean, band = mean_and_band([[(0, 0.0), (10, 10.0), (20, 20.0)], [(10, 30.0), (30, 50.0)]])
    # the second curve starts at 10 and reads 40 at 20
    np.testing.assert_array_equal(frames, [10, 20])
    np.testing.assert_array_equal(mean, [20, 30])
    np.testing.assert_array_equal(band, [10, 10])


def saved_run(path: Path, env_id: str, text: str, **settings: object) -> Path:
    path.mkdir()
    (path / "config.json").write_text(json.dumps({"recipe": "ppo", "settings": {"env_id": env_id, **settings}}))
    (path / "metrics.csv").write_text(text)
    return path


def test_several_runs_and_envs_make_one_figure(tmp_path: Path):
    text = "frames,rollout/ep_rew_mean,eval/mean_reward\n10,,\n20,1.0,2.0\n30,2.0,\n"
    runs = [saved_run(tmp_path / name, env, text) for name, env in (("a", "X-v0"), ("b", "X-v0"), ("c", "Y-v0"))]
    run.plot(runs, tmp_path / "out.svg")
    assert (tmp_path / "out.svg").read_text().startswith("<?xml")


def test_runs_are_averaged_over_seeds_and_told_apart_by_settings(tmp_path: Path):
    text = "frames,time/wall_s,rollout/ep_rew_mean\n10,60,1.0\n20,120,2.0\n"
    agents = [("a", {"seed": 1, "clip": 0.2}), ("b", {"seed": 2, "clip": 0.2}), ("c", {"seed": 1, "clip": 0.1})]
    runs = [saved_run(tmp_path / name, "X-v0", text, **settings) for name, settings in agents]
    run.plot(runs, tmp_path / "out.svg", x="wall")
    drawn = (tmp_path / "out.svg").read_text()
    labels = ("ppo clip=0.2 training (2 seeds)", "ppo clip=0.1 training", "minutes")
    assert all(f"<!-- {label} -->" in drawn for label in labels) and "<!-- frames -->" not in drawn


def test_a_run_with_nothing_in_it_yet_still_plots(tmp_path: Path):
    run.plot([saved_run(tmp_path / "a", "X-v0", "frames\n")], tmp_path / "out.png")
    assert (tmp_path / "out.png").exists()


def test_runs_without_frames_in_common_are_drawn_apart(tmp_path: Path):
    runs = [
        saved_run(tmp_path / name, "X-v0", f"frames,rollout/ep_rew_mean\n{text}\n")
        for name, text in (("a", "10,1.0\n20,2.0"), ("b", "30,1.0\n40,2.0"))
    ]
    run.plot(runs, tmp_path / "out.svg")
    assert "<!-- ppo training (2 runs) -->" in (tmp_path / "out.svg").read_text()


def test_plot_errors(tmp_path: Path):
    with pytest.raises(UserError, match="not a run directory"):
        run.plot([tmp_path], tmp_path / "out.png")
    member = saved_run(tmp_path / "a", "X-v0", "frames\n")
    with pytest.raises(UserError, match="cannot write"):
        run.plot([member], tmp_path / "out.unknown")
    with pytest.raises(UserError, match="it is a directory"):
        run.plot([member], tmp_path)
