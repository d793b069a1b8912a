"""The results in docs/: tables are whole, pages say what the tables say, one cheap cell gives the same again."""

import json
import shlex
from pathlib import Path

import pytest

from pgkit.run import experiment
from pgkit.run.report import MARKS, PUBLISHED, by_task, markdown, others
from tests.recipes.test_ppo import pgkit

DOCS = Path(__file__).resolve().parents[2] / "docs"
TABLES = [path for path in sorted((DOCS / "results").glob("*.csv")) if path.stem != "published"]
RESULTS = [path for path in TABLES if not path.stem.endswith("-curves")]


@pytest.mark.parametrize("table", RESULTS, ids=lambda path: path.stem)
def test_a_table_has_each_run_once_with_its_curve(table):
    rows = experiment.read(table)
    runs = [(row["recipe"], row["env"], row["settings"], row["seed"]) for row in rows]
    assert len(set(runs)) == len(runs) > 0
    curves = experiment.read(table.with_name(f"{table.stem}-curves.csv"), experiment.CURVE)
    last = {(r["recipe"], r["env"], r["settings"], r["seed"]): float(r["eval_mean"]) for r in curves}
    assert [last[run] for run in runs] == [float(row["eval_mean"]) for row in rows]


@pytest.mark.parametrize("table", RESULTS, ids=lambda path: path.stem)
def test_a_page_says_what_its_table_says(table):
    page = DOCS / "pages" / "results" / f"{table.stem}.md"
    text = page.read_text(encoding="utf-8")
    assert all(mark in text for mark in MARKS)
    rows, published = experiment.read(table), others(DOCS / "results" / "published.csv")
    for part in markdown(by_task(rows), rows, published):
        assert part in text, f"make it again: pgkit report {table} --published ... --out {page}"


def test_published_scores_have_a_source():
    rows = experiment.read(DOCS / "results" / "published.csv", PUBLISHED)
    assert rows and all(row["score"] and row["source"] for row in rows)


@pytest.mark.slow
def test_one_cell_gives_the_same_again(tmp_path):
    row = experiment.read(DOCS / "results" / "cartpole.csv")[0]
    flags = shlex.split(row["settings"])
    pgkit("run", row["recipe"], "--env-id", row["env"], "--seed", row["seed"], "--run-dir", tmp_path / "run", *flags)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["eval/mean_reward"] == pytest.approx(float(row["eval_mean"]), rel=0.02)
    assert summary["frames"] == int(row["frames"])
