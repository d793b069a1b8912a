"""Reports of results tables: by hand from rows that are written here."""

import csv

import pytest

from pgkit.errors import UserError
from pgkit.run import experiment
from pgkit.run.report import legend, report


def write(path, columns, rows):
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def tables(folder):
    results = [["ppo", "X-v1", "", seed, 20, 10.0 * seed, 2, 100, ""] for seed in (1, 2, 3, 4)]
    write(folder / "t.csv", experiment.COLUMNS, results)
    curves = {1: (5, 40), 2: (60, 50), 3: (20, 70), 4: (1, 2)}  # evaluations after 10 and 20 frames, 1 and 3 minutes
    points = [
        ["ppo", "X-v1", "", seed, frames, score, minutes]
        for seed, pair in curves.items()
        for frames, minutes, score in zip((10, 20), (1, 3), pair, strict=True)
    ]
    write(folder / "t-curves.csv", experiment.CURVE, points)
    return [folder / "t.csv"]


def test_published_scores_stand_beside_those_of_the_same_settings(tmp_path):
    rows = [["ppo", "X-v1", "", "30", "A"], ["ppo", "X-v1", "", "17 ± 2", "B"], ["ppo", "X-v1", "--gamma 1", "99", "C"]]
    write(tmp_path / "others.csv", ("recipe", "env", "settings", "score", "source"), rows)
    text = report(tables(tmp_path), tmp_path / "r.md", published=tmp_path / "others.csv")
    assert "| X-v1 | ppo |  | 4 | 25.0 | 25.0 (" in text and "| 2.0 | 100 | 30 (A); 17 ± 2 (B) |" in text
    assert "99" not in text
    with pytest.raises(UserError, match="no such file"):
        report(tables(tmp_path), tmp_path / "r.md", published=tmp_path / "none.csv")


def test_the_time_to_a_score_is_the_median_over_seeds_of_the_first_evaluation_above_it(tmp_path):
    text = report(tables(tmp_path), tmp_path / "r.md", reach=[40, 50, 60])
    # 40: seeds 1 to 3 after 20, 10, 20 frames, 4 never; 50: seeds 2 and 3; half of four do not, so there is no median
    assert "| X-v1 | ppo | 40 | 3 of 4 | 20 | 3.0 |" in text
    assert "| X-v1 | ppo | 50 | 2 of 4 | - | - |" in text
    assert "| X-v1 | ppo | 60 | 2 of 4 | - | - |" in text


def test_text_around_the_marks_stays(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Mine\n\nBefore.\n\n<!-- report -->\nold\n<!-- end of report -->\n\nAfter.\n")
    for _ in range(2):
        text = report(tables(tmp_path), page)
        assert text == page.read_text() and "old" not in text and text.count("| X-v1 |") == 1
        assert text.startswith("# Mine\n\nBefore.\n\n<!-- report -->\n\n| env |")
        assert text.endswith("\n\n<!-- end of report -->\n\nAfter.\n")


def test_a_legend_has_no_flags_that_all_share_so_that_the_curves_keep_their_room(tmp_path):
    long = "--total-frames 2048 --num-envs 4 --steps 64 --epochs 2 --hidden 64 64 --compile off --eval-episodes 2"
    groups = [("ppo", long), ("ppo", f"{long} --learning-rate 1e-3"), ("sac", long)]
    assert list(legend(groups).values()) == ["ppo", "ppo --learning-rate 1e-3", "sac"]
    assert legend([("ppo", "--hidden 64 64"), ("ppo", "--hidden 256")])["ppo", "--hidden 256"] == "ppo --hidden 256"
    results = [[recipe, "X-v1", flags, seed, 20, 10.0, 2, 100, ""] for recipe, flags in groups for seed in (1, 2)]
    write(tmp_path / "t.csv", experiment.COLUMNS, results)
    points = [[recipe, "X-v1", flags, seed, 20, 10.0, 2] for recipe, flags in groups for seed in (1, 2)]
    write(tmp_path / "t-curves.csv", experiment.CURVE, points)
    report([tmp_path / "t.csv"], tmp_path / "r.md")  # matplotlib warns where the legend leaves no room
