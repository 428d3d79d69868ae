"""Lines of the table: what fits is printed, reasons are merged, the best run stands first."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssm_study.engine.records import write_record
from ssm_study.table import show
from ssm_study.table.alike_sentences import merge_number_ranges
from ssm_study.table.gather import rows_differ_from_records, table_from_records
from ssm_study.table.over_seeds import align_columns, setting_heading
from ssm_study.table.show import (
    certificate_verdicts,
    column_description_lines,
    computing_time_lines,
    format_cell,
    gather_rows,
    prediction_verdicts,
    print_rows,
    render_table,
    short_column_heading,
    short_run_names,
    show_table,
    stage_computing_times,
    status_summary_lines,
)

Row = dict[str, Any]


def table_of(*rows: Mapping[str, Any]) -> pd.DataFrame:
    """Table of these runs, named by their number where they have no name."""
    named = [{"run": f"r-{number}", **row} for number, row in enumerate(rows)]
    return table_from_records(named)


def write_study(folder: Path, *rows: Mapping[str, Any]) -> Path:
    """A study of these runs."""
    for number, row in enumerate(rows):
        run = folder / f"r-{number}"
        run.mkdir(parents=True)
        record = {"run": run.name, **row}
        write_record(run, record)
    return folder


# Cells.

CELLS: dict[str, list[Any]] = {
    "-": [None, pd.NA],
    "yes": [True, np.True_],
    "no": [False, np.False_],
    "0.3333": [1 / 3, np.float64(1 / 3)],
    "1.235e+04": [12346.0],
    "12345": [12345],
    "\\x1b[2J": ["\x1b[2J"],
}


def test_cells_have_four_digits_and_no_commands() -> None:
    cells = {text: [format_cell(value) for value in values] for text, values in CELLS.items()}
    expected = {text: [text] * len(values) for text, values in CELLS.items()}
    assert cells == expected


def test_certificates_and_predictions_are_words() -> None:
    verdicts = [(True, True), (True, False), (False, True), (False, False), (None, None)]
    rows = [
        {"controller_certified": ours, "observer_certified": theirs} for ours, theirs in verdicts
    ]
    table = table_of(*rows)
    words = certificate_verdicts(table)
    expected = ["both", "ctl", "obs", "no", "-"]
    values = words.fillna("-").tolist()
    assert values == expected
    pairs = [
        (True, "good"),
        (True, "doubt"),
        (False, "doubt"),
        (True, "cannot judge"),
        (None, None),
    ]
    rows = [{"predicted_stable": stable, "evidence": evidence} for stable, evidence in pairs]
    table = table_of(*rows)
    words = prediction_verdicts(table)
    expected = ["yes", "yes, doubt", "no", "cannot judge", "-"]
    values = words.fillna("-").tolist()
    assert values == expected


HEADINGS = {
    "certified": "cert",
    "plant__step_s": "step_s",
    "hidden_width": "width",
    "order": "order",
    "settling_time_mean_s": "settle s",
}


def test_headings_are_short() -> None:
    headings = {name: short_column_heading(name) for name in HEADINGS}
    assert headings == HEADINGS
    assert setting_heading("hidden_width") == "width"
    assert setting_heading("order") == "order"
    assert setting_heading("plant__step_s") == "plant__step_s"


def test_digits_name_a_run_where_no_other_has_them() -> None:
    names = pd.Series(["a-b-1", "a-c-2"])
    expected = ["1", "2"]
    values = short_run_names(names).tolist()
    assert values == expected
    alike = pd.Series(["a-1", "b-1"])
    expected = ["a-1", "b-1"]
    values = short_run_names(alike).tolist()
    assert values == expected


# Widths.


@given(st.integers(1, 60))
def test_a_table_fills_its_width_and_no_more(width: int) -> None:
    rows = [{"status": "ok", "order": k, "seed": 10**k, "hidden_width": 3 * k} for k in range(3)]
    table = table_of(*rows)
    text = render_table(table, width=1000)
    full = text.splitlines()
    text = render_table(table, width=width)
    lines = text.splitlines()
    heads = lines[0].split()
    assert heads[0] == "run"
    if heads != ["run"]:
        actual = max(map(len, lines))
        assert actual <= width - 2
    if width >= max(map(len, full)) + 2:
        assert lines == full


def test_texts_stand_left_and_numbers_right() -> None:
    table = table_of({"status": "ok", "order": 4}, {"status": "infeasible", "order": 12})
    text = render_table(table)
    lines = text.splitlines()
    assert lines == ["run  status      order", "0    ok              4", "1    infeasible     12"]
    aligned = align_columns([["setting", "n"], ["a", "10"]])
    assert aligned == ["setting   n", "a        10"]


def test_a_column_sorted_by_stands_second() -> None:
    table = table_of({"status": "ok", "seconds": 1.5}, {"status": "ok", "seconds": 2.5})
    text = render_table(table, "seconds")
    heads = text.splitlines()[0]
    expected = ["run", "seconds", "status"]
    assert heads.split() == expected


def test_a_setting_that_tells_no_further_runs_apart_gives_way() -> None:
    rows = [
        {"status": "ok", "order": order, "hidden_width": 8 * order, "slope_lower": slope}
        for order in (2, 4)
        for slope in (0.1, None)
    ]
    table = table_of(*[row | {"fit_test_percent": 90.0} for row in rows])
    text = render_table(table)
    wide = text.splitlines()[0]
    expected = ["run", "status", "order", "width", "mu", "fit", "%"]
    assert wide.split() == expected
    needed = len("run  status  order   mu  fit %") + 2
    text = render_table(table, width=needed)
    narrow = text.splitlines()[0]
    expected = ["run", "status", "order", "mu", "fit", "%"]
    assert narrow.split() == expected


# Sentences below the table.


def test_the_summary_counts_and_says_what_to_do() -> None:
    rows = [{"status": "lost"}, {"status": "corrupt"}, {"status": "running"}]
    rows += [{"status": "failed"}, {"status": "infeasible", "infeasible_reason": "no"}]
    rows.append({"status": "ok", "uncertified_reason": "digits"})
    table = table_of(*rows)
    lines = status_summary_lines(table, printed_count=6)
    expected = [
        "",
        "6 runs: 1 ok, 1 infeasible, 1 failed, 1 lost, 1 corrupt, 1 running",
        "  failed 3: no reason was recorded",
        "  infeasible 4: no",
        "  not certified 5: digits",
        "  lost 0: stopped before it ended; the same command runs it again",
        "  corrupt 1: record.json is damaged; the same command runs it again",
    ]
    assert lines == expected
    table = table_of(*rows)
    shown = status_summary_lines(table, printed_count=5)
    assert shown[1].startswith("6 runs (5 shown): ")


def test_five_runs_of_a_reason_are_named_and_twenty_reasons() -> None:
    rows = [{"status": "failed", "error_message": "one"}] * 5
    table = table_of(*rows)
    lines = status_summary_lines(table, 5)
    assert lines[2] == "  failed 0, 1, 2, 3, 4: one"
    table = table_of(*rows, *rows[:1])
    lines = status_summary_lines(table, 6)
    assert lines[2] == "  failed 0, 1, 2, 3, 4 and 1 more: one"
    messages = [chr(ord("a") + k) for k in range(22)]
    rows = [{"status": "failed", "error_message": message} for message in messages]
    table = table_of(*rows[:20])
    count = len(status_summary_lines(table, 20))
    assert count == 22
    table = table_of(*rows)
    lines = status_summary_lines(table, 22)
    assert len(lines) == 23
    assert lines[-1] == "  ... failed for 2 more reasons"


@given(st.lists(st.integers(-50, 50), min_size=1))
def test_merged_sentences_give_the_range_of_each_number(numbers: list[int]) -> None:
    sentences = [f"rate {number} of S_u2, at least 7" for number in numbers]
    smallest = min(numbers)
    largest = max(numbers)
    both = f"{smallest} to {largest}" if smallest < largest else str(smallest)
    assert merge_number_ranges(sentences) == f"rate {both} of S_u2, at least 7"


def fold_row(fold: int, fit: float | None, **more: object) -> Row:
    return {"status": "ok", "fold": fold, "fit_test_percent": fit, **more}


def test_folds_are_grouped_by_settings_of_the_model_alone() -> None:
    rows = [fold_row(fold, fit, rate_controller=fold) for fold, fit in ((0, 80.0), (1, 90.0))]
    table = table_of(*rows)
    lines = status_summary_lines(table, 2)
    assert lines[2:] == ["  2 folds: mean test fit 85 %, deviation 7.071 %"]
    by_order = [row | {"order": order} for order in (2, 4) for row in rows]
    table = table_of(*by_order)
    lines = status_summary_lines(table, 4)
    tails = [line.rpartition(", ")[2] for line in lines[2:]]
    assert tails == ["order 2", "order 4"]
    missing = [row | {"order": None} for row in rows]
    table = table_of(*by_order[:2], *missing)
    lines = status_summary_lines(table, 4)
    assert len(lines) == 4


def test_costs_are_listed_with_the_longest_first() -> None:
    rows = [
        {"stage_data_key": "d", "stage_data_seconds": 2.0},
        {"stage_model_key": "m", "stage_model_seconds": 30.0},
        {"stage_model_key": "m", "stage_model_seconds": 30.0},
        {"stage_model_key": "n", "stage_model_seconds": None},
    ]
    table = table_of(*rows)
    costs = stage_computing_times(table)
    expected = [2, 1, 30.0, 30.0]
    values = costs.loc["model"].tolist()
    assert values == expected
    head, first, second, together = computing_time_lines(table)
    expected = ["stage", "runs", "distinct", "reused", "each", "cost", "saved"]
    assert head.split() == expected
    expected = ["model", "2", "1", "1", "30.00", "s", "30", "s", "30", "s"]
    assert first.split() == expected
    expected = ["data", "1", "1", "0", "2.00", "s"]
    actual = second.split()[:6]
    assert actual == expected
    expected = ["together", "32", "s", "30", "s"]
    assert together.split() == expected
    lengths = {len(line) for line in (head, first, second, together)}
    assert lengths == {69}


def test_the_columns_are_listed_in_four_aligned_parts() -> None:
    table = table_of({"status": "ok", "seconds": 1.0})
    head, *lines = column_description_lines(table)
    starts = [head.index(word) for word in ("what it is", "better", "checked by")]
    (line,) = [line for line in lines if line.startswith("seconds")]
    parts = ["seconds", "low", "not checked: depends on when it ran"]
    found = [line.index(part, start) for part, start in zip(parts, starts, strict=True)]
    assert found == starts
    assert all(line == line.rstrip() for line in lines)


# Printing.


def test_columns_or_costs_are_printed_in_place_of_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = write_study(tmp_path / "study", {"status": "ok"}, {"status": "failed"})
    table = show_table(study, columns=True, cost=True)
    assert len(table) == 2
    assert capsys.readouterr().out.startswith("column ")
    show_table(study, cost=True)
    printed = capsys.readouterr().out
    assert printed.startswith("stage ")
    assert "2 runs" not in printed
    show_table(study, where="status == 'ok'")
    assert "2 runs (1 shown)" in capsys.readouterr().out


def test_seeds_and_missing_runs_stand_below_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [{"status": "ok", "seed": seed, "fit_test_percent": 90.0 + seed} for seed in (0, 1)]
    study = write_study(tmp_path / "study", *rows)
    task = "hydra: {overrides: {task: ['seed=0,1,2']}}"
    (study / "multirun.yaml").write_text(task)
    show_table(study)
    printed = capsys.readouterr().out
    assert "90.5 ± 0.71" in printed
    assert "1 of 3 runs of the sweep is missing" in printed


def test_only_a_table_that_contradicts_its_records_is_gathered_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = write_study(tmp_path / "study", {"status": "ok"}, {"status": "failed"})
    gathered: list[bool] = []
    original = show.gather

    def gather_and_note(study: Path, anew: bool, must_write: bool) -> pd.DataFrame:
        gathered.append(anew)
        return original(study, anew, must_write)

    monkeypatch.setattr(show, "gather", gather_and_note)
    gather_rows(study, None, None)
    assert gathered == [False]
    monkeypatch.setattr(show, "rows_differ_from_records", lambda *_: True)
    gather_rows(study, None, None)
    assert gathered == [False, False, True]


def test_a_terminal_has_colours_and_its_own_width(monkeypatch: pytest.MonkeyPatch) -> None:
    printed: list[tuple[str, str]] = []

    class Terminal:
        is_terminal = True
        width = 120

        def __init__(self, **_: object) -> None: ...

        def print(self, line: show.Text, soft_wrap: bool) -> None:
            assert soft_wrap
            printed.append((line.plain.split()[0], str(line.style)))

    widths: list[int] = []
    monkeypatch.setattr(show, "Console", Terminal)
    original = show.render_table

    def render_and_note(rows: pd.DataFrame, by: str | None, width: int) -> str:
        widths.append(width)
        return original(rows, by, width)

    monkeypatch.setattr(show, "render_table", render_and_note)
    rows = table_of({"status": "ok"}, {"status": "failed"}, {"status": "infeasible"})
    print_rows(rows, None)
    expected = [("run", "bold"), ("0", ""), ("1", "red"), ("2", "yellow")]
    assert printed == expected
    monkeypatch.setattr(Terminal, "width", 40)
    print_rows(rows, None)
    monkeypatch.setattr(Terminal, "width", 120)
    monkeypatch.setattr(Terminal, "is_terminal", False)
    print_rows(rows, None)
    assert widths == [120, 80, 80]


def test_a_row_of_a_removed_record_differs(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study", {"status": "ok", "stage_loop_seconds": 1.0, "zz": 1})
    table = show.gather(study)
    assert not rows_differ_from_records(study, table)
    assert not rows_differ_from_records(study, table.assign(zz=2)), "declared columns alone"
    assert rows_differ_from_records(study, table.assign(stage_loop_seconds=2.0))
    (study / "r-0" / "record.json").unlink()
    assert rows_differ_from_records(study, table)
