"""A column is declared once, where it is computed, and there is one notion of best."""

import shutil
from pathlib import Path

import pandas as pd
import pytest
from fresh_programs import start_program

from ssm_study.report.page.data import sort_for_page
from ssm_study.report.study_folder import StudyFolder
from ssm_study.table.columns import DECLARED, column_label, find_declaration
from ssm_study.table.gather import table_from_records
from ssm_study.table.rank import rank_runs
from ssm_study.table.show import render_table, short_run_names

ROOT = Path(__file__).resolve().parents[2]
COMMITTED = sorted(path.parent for path in (ROOT / "results" / "reference").glob("*/runs.csv"))

# One file each: a number that the recordings give again, and one that they do not.
ADDED = {
    "ssm_study/loop/metrics.py": {
        "EFFORT_AND_ERROR_COLUMNS = (": (
            'Column("input_mean_square", "Float64", "low", '
            'word="Mean square of the input", unit="V²"),'
        ),
        '"input_peak_v": input_peak_v,': ('"input_mean_square": float((efforts[0] ** 2).mean()),'),
    },
    "ssm_study/training/metrics.py": {
        "COLUMNS = (": (
            'Column("curve_rows", "Int64", word="Rows of the curve", '
            'unchecked="the curve is not kept"),'
        ),
        '"training_seconds": seconds,': '"curve_rows": len(reason_of_end),',
    },
}
# One program for all: to load the libraries takes longer than what it does with them.
PROGRAM = """
import json
import os
import sys
from pathlib import Path
os.chdir(SCRATCH)
sys.path.insert(0, SCRATCH)
from ssm_study.cli import summary as endings
from ssm_study.cli.main import main
from ssm_study.report.page.data import page_data
from ssm_study.report.study_folder import StudyFolder
endings.RUN_FIGURES = ()
words = ["experiment=smoke", "synthesis=riccati", "+data.trials=false", "data.fresh_sets=0"]
words += ["data.trajectories=2", "data.samples=200", "data.test_samples=200"]
words += ["data.validation_samples=200", "training.max_epochs=2"]
words += ["loop.initial_conditions=2", "progress=false"]
assert main(["run", *words, "results_dir=results"]) == 0
(run,) = (path.parent for path in Path("results/smoke").glob("*/record.json"))
assert main(["show", str(run.parent), "--columns"]) == 0
words = page_data(StudyFolder(folder=run.parent))["words"]
print(json.dumps([words[name] for name in ("input_mean_square", "curve_rows")]))
assert main(["verify", "-v", str(run)]) == 0
"""


def scratch_copy(folder: Path) -> Path:
    """The package and its configuration with two more columns, each written into one file."""
    for name in ("ssm_study", "hydra_plugins", "conf"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("*.pyc.*", "*.tmp.*")
        )  # half written
    for file, additions in ADDED.items():
        text = (folder / file).read_text()
        for mark, added in additions.items():
            assert text.count(mark) == 1
            text = text.replace(mark, f"{mark} {added} ")
        (folder / file).write_text(text)
    return folder


def test_a_new_column_is_one_file(tmp_path: Path, smoke_study: Path) -> None:
    assert smoke_study.is_dir()  # made before: what it has compiled is copied
    scratch = scratch_copy(tmp_path / "scratch")
    program = PROGRAM.replace("SCRATCH", repr(str(scratch)))
    done = start_program(program, tmp_path / "program").wait(timeout_s=250)
    assert done.returncode == 0, done.stdout + done.stderr
    table = pd.read_csv(scratch / "results" / "smoke" / "runs.csv")
    columns = list(table.columns)
    of_training = ["fit_test_percent", "curve_rows", "training_ended"]
    of_the_loop = ["settling_time_mean_s", "input_mean_square", "input_peak_v"]
    for neighbours in (of_training, of_the_loop):
        assert sorted(neighbours, key=columns.index) == neighbours
    assert "Mean square of the input (V²)" in done.stdout
    assert "not checked: the curve is not kept" in done.stdout
    assert "declared nowhere" not in done.stdout
    assert '["Mean square of the input (V\\u00b2)", "Rows of the curve"]\n' in done.stdout
    assert "holds  input_mean_square" in done.stdout


def test_names_are_declared_once_and_patterns_cover_no_other_column() -> None:
    names = [column.name for column in DECLARED]
    assert len(set(names)) == len(names)
    assert all(
        find_declaration(column.name) is column for column in DECLARED if not column.is_pattern
    )
    assert find_declaration("score_test_2") is find_declaration("score_test_*")
    assert find_declaration("stage_model_key") is not find_declaration("stage_model_seconds")
    assert find_declaration("nothing_such") is None
    actual = column_label("settling_time_mean_s")
    assert actual == "Mean settling time (s)"
    assert column_label("nothing_such") == "nothing such"
    assert column_label("score_test_2") == "Benchmark score 2"


@pytest.mark.parametrize("folder", COMMITTED, ids=lambda path: path.name)
def test_show_page_and_figures_name_the_same_run(folder: Path) -> None:
    records = (
        pd.read_csv(folder / "runs.csv")
        .astype(object)
        .where(lambda t: t.notna(), None)
        .to_dict("records")
    )
    table = table_from_records(records)
    run = rank_runs(table)["run"]
    best = run.iloc[0]
    lines = render_table(rank_runs(table)).splitlines()
    run = rank_runs(table)["run"]
    expected = short_run_names(run).iloc[0]
    assert lines[1].split()[0] == expected
    run = sort_for_page(table)["run"]
    assert run.iloc[0] == best


def test_a_figure_shows_the_best_run(tmp_path: Path) -> None:
    rows = [
        {"run": name, "status": "ok", "settling_time_mean_s": seconds, "stable_fraction": 1.0}
        | {
            f"{side}_{what}": certified
            for side in ("controller", "observer")
            for what in ("feasible", "certified")
        }
        for name, seconds, certified in (
            ("slow", 2.0, True),
            ("quick", 1.0, True),
            ("bare", 0.1, False),
        )
    ]
    table = table_from_records(rows)
    table.to_parquet(tmp_path / "runs.parquet")
    for name in table["run"]:
        (tmp_path / name).mkdir()
        model_path = tmp_path / name / "model.json"
        model_path.touch()
    best = StudyFolder(folder=tmp_path).best_run
    assert best is not None
    run = rank_runs(table)["run"]
    expected = run.iloc[0]
    assert best.path.name == expected == "quick"
