import csv
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from pgkit.run.metrics import Metrics, averages, column, finished_episodes, finished_infos, read_csv


def write(run_dir: Path, *rows: dict[str, float], upto: int = 0) -> Path:
    metrics = Metrics(run_dir, upto)
    for row in rows:
        metrics.write(row)
    metrics.close()
    return run_dir / "metrics.csv"


def test_a_new_column_is_added_to_the_header_and_left_empty_above(tmp_path: Path):
    path = write(tmp_path, {"frames": 1, "a": 0.5}, {"frames": 2, "a": 0.25, "eval/x": 3.0}, {"frames": 3, "a": 1.0})
    assert path.read_text().splitlines() == ["frames,a,eval/x", "1,0.5,", "2,0.25,3.0", "3,1.0,"]


def test_resume_drops_the_rows_past_the_checkpoint_and_appends(tmp_path: Path):
    write(tmp_path, {"frames": 10, "a": 1.0, "b": 1.0}, {"frames": 20, "a": 2.0}, {"frames": 30, "a": 3.0})
    path = write(tmp_path, {"frames": 30, "b": 9.0, "a": 8.0, "c": 7.0}, upto=20)
    assert path.read_text().splitlines() == ["frames,a,b,c", "10,1.0,1.0,", "20,2.0,,", "30,8.0,9.0,7.0"]


def test_numbers_come_back_exactly_and_nan_is_empty(tmp_path: Path):
    value = float(np.float32(0.1)) / 3
    path = write(
        tmp_path,
        {"frames": 1, "a": value, "b": float("nan")},
        {"frames": 2, "a": np.float64(value), "b": 1.0},
    )
    rows = read_csv(path)[1]
    assert column(rows, "a") == [(1, value), (2, value)]
    assert column(rows, "b") == [(2, 1.0)]
    with path.open(newline="") as file:
        assert next(csv.DictReader(file))["b"] == ""


def test_tensorboard_gets_the_same_scalars(tmp_path: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write(tmp_path, {"frames": 10, "train/x": 0.5}, {"frames": 20, "train/x": 0.25})
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(event.step, event.value) for event in events.Scalars("train/x")] == [(10, 0.5), (20, 0.25)]


def test_tensorboard_forgets_what_a_resume_drops(tmp_path: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write(tmp_path, {"frames": 10, "x": 1.0}, {"frames": 20, "x": 2.0}, {"frames": 30, "x": 3.0})
    write(tmp_path, {"frames": 40, "x": 4.0}, upto=20)
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(event.step, event.value) for event in events.Scalars("x")] == [(10, 1.0), (20, 2.0), (40, 4.0)]


def test_finished_episodes_are_those_where_done_oldest_first():
    done = torch.tensor([[0, 0, 1], [1, 0, 0]], dtype=torch.bool)  # env 1 ends at t = 0, env 0 at t = 2
    reward = torch.tensor([[1.0, 2.0, 3.0], [10.0, 1.0, 2.0]])
    steps = torch.tensor([[1, 2, 3], [8, 1, 2]])
    entries = {"done": done, "episode_reward": reward, "step_count": steps}
    following = {name: value.unsqueeze(-1) for name, value in entries.items()}
    assert finished_episodes(TensorDict({"next": following}, [2, 3])) == [(10.0, 8), (3.0, 3)]
    assert finished_episodes(TensorDict({"next": {"done": done.unsqueeze(-1)}}, [2, 3])) == []


def test_averages_are_over_the_rows_that_have_the_name():
    assert averages([{"a": 1.0, "b": 4.0}, {"a": 2.0}]) == {"a": 1.5, "b": 4.0}
    assert averages([]) == {}


def test_a_line_that_was_cut_short_is_left_out(tmp_path: Path):
    path = tmp_path / "metrics.csv"
    path.write_text("frames,a,b\n10,1,2\n20,3,4\n3")
    assert [row["frames"] for row in read_csv(path)[1]] == ["10", "20"]


def test_declared_infos_of_finished_episodes_are_logged_under_their_names():
    done = torch.tensor([[[True], [False], [True]], [[False], [True], [False]]])
    success = torch.tensor([[[1.0], [9.0], [0.0]], [[9.0], [1.0], [9.0]]])
    length = torch.tensor([[[4.0], [9.0], [float("nan")]], [[9.0], [8.0], [9.0]]])
    after = {"done": done, "is_success": success, "episode": {"l": length}, "observation": success, "reward": success}
    rollout = TensorDict({"observation": success, "next": after}, [2, 3])
    assert finished_infos(rollout) == {"rollout/success_rate": 2 / 3, "rollout/episode_l": 6.0}
    assert finished_infos(TensorDict({"next": {"done": done & False, "is_success": success}}, [2, 3])) == {}
    assert finished_infos(None) == {}
