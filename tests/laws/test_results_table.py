"""Gathering and showing: typed columns in the agreed order, missing is null, filters compute
nothing."""

import json
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_tables import SCHEMA

from ssm_study.durable import json_bytes
from ssm_study.engine.records import write_record
from ssm_study.refusal import BadRequest
from ssm_study.table.columns import COLUMNS
from ssm_study.table.filters import filter_rows
from ssm_study.table.gather import gather
from ssm_study.table.rank import rank_runs
from ssm_study.table.show import render_table, show_table, status_summary_lines

CERTIFIED_RUN = {
    "run": "a",
    "status": "ok",
    "order": 8,
    "fit_test_percent": 91.5,
    "stable_fraction": 1.0,
    "settling_time_mean_s": 2.0,
    "controller_certified": True,
    "extra": 1,
}
UNCERTIFIED_RUN = {
    "run": "b",
    "status": "ok",
    "order": 4,
    "fit_test_percent": 80.0,
    "stable_fraction": 1.0,
    "settling_time_mean_s": 1.0,
    "controller_certified": False,
}
FAILED_RUN = {"run": "c", "status": "failed", "order": 8, "error_message": "the solver gave up"}
INFEASIBLE_RUN = {
    "run": "d",
    "status": "infeasible",
    "order": 6,
    "rate_controller": 0.8,
    "controller_feasible": False,
    "controller_rate_limit": 0.91,
    "infeasible_reason": "rate 0.8 is too much",
}
UNSTABLE_RUN = {
    "run": "e",
    "status": "ok",
    "order": 6,
    "fit_test_percent": 99.0,
    "stable_fraction": 0.4,
    "mismatch_gain": float("inf"),
    "zz": "text",
}
RECORDS = [CERTIFIED_RUN, UNCERTIFIED_RUN, FAILED_RUN, INFEASIBLE_RUN, UNSTABLE_RUN]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for record in RECORDS:
        run = str(record["run"])
        folder = tmp_path / "study" / run
        folder.mkdir(parents=True)
        write_record(folder, {"study": "study", **record})
    no_run_path = tmp_path / "study" / "no_run"
    no_run_path.mkdir()
    (tmp_path / "study" / ".hidden").mkdir()
    return tmp_path / "study"


def test_the_agreed_columns_come_first_with_their_types(study: Path) -> None:
    gather(study)
    path = study / "runs.parquet"
    table = pd.read_parquet(path, dtype_backend="numpy_nullable")
    names = [column.name for column in COLUMNS]
    table_names = list(table.columns)
    agreed = len(names)
    assert table_names[:agreed] == names
    others = table_names[agreed:]
    assert others == sorted(others)
    dtype_by_name = {name: str(table[name].dtype) for name in names}
    expected = {column.name: column.kind for column in COLUMNS}
    assert dtype_by_name == expected
    schema = SCHEMA.split()
    assert set(schema) <= set(names)  # scripts rely on these


def test_missing_is_null_and_never_zero(study: Path) -> None:
    table = gather(study).set_index("run")
    missing = table.loc["c", ["fit_test_percent", "seed", "controller_certified"]]
    assert missing.isna().all()
    infinity = float("inf")
    assert table.loc["e", "mismatch_gain"] == infinity
    assert table.loc["d", "controller_feasible"] == False  # noqa: E712
    text = (study / "runs.csv").read_text()
    lines = text.splitlines()
    heads = "study,run,status,plant,seed,excitation,fold,fresh_sets,model,order,hidden_width"
    assert lines[0].startswith(heads)
    assert lines[3].startswith("study,c,failed,,,,,,,8,,")


def test_a_value_of_another_type_is_missing(study: Path) -> None:
    record = {"status": "ok", "study": "x"}
    record |= {"order": "eight", "fit_test_percent": True, "seed": 1.5}
    write_record(study / "c", record)
    table = gather(study).set_index("run")
    row = table.loc["c"]
    of_other_types = row[["order", "fit_test_percent", "seed"]]
    assert of_other_types.isna().all()
    assert row["study"] == "study"


def test_a_damaged_record_is_a_corrupt_row(study: Path) -> None:
    record_path = study / "a" / "record.json"
    text = record_path.read_text()
    damaged = text.replace("91.5", "97.5")
    record_path.write_text(damaged)
    table = gather(study).set_index("run")
    row = table.loc["a"]
    assert row["status"] == "corrupt"
    assert pd.isna(row["fit_test_percent"])


def read_tables(study: Path) -> tuple[bytes, bytes]:
    text = (study / "runs.csv").read_bytes()
    parquet = (study / "runs.parquet").read_bytes()
    return text, parquet


def test_gathering_twice_gives_the_same_bytes(study: Path) -> None:
    gather(study)
    first = read_tables(study)
    gather(study)
    assert read_tables(study) == first


COMPARISONS = {
    "order == 8": "ac",
    "8 == order": "ac",
    "80 < fit_test_percent <= 95": "a",
    "fit_test_percent > -1": "abe",
    "fit_test_percent != 80": "ae",
    "zz != 'other'": "e",
    "controller_rate_limit > rate_controller": "d",
    "order + 5 == 9": "b",
}
MEMBERSHIPS = {
    "order in [4, 6]": "bde",
    "order not in (4, 6)": "ac",
    "fit_test_percent not in [80, 99]": "a",
}
LOGICAL_EXPRESSIONS = {
    "order >= 6 and status == 'ok'": "ae",
    "not (order == 8)": "bde",
    "not (fit_test_percent > 85)": "bcd",
    "controller_certified": "a",
    "not controller_certified": "bcde",
    "mismatch_gain == inf or run == 'b'": "be",
}
MISSING_VALUES = {
    "fit_test_percent == null": "cd",
    "fit_test_percent != None": "abe",
    "controller_certified == null": "cde",
    "controller_certified != null and controller_certified == false": "b",
}
FILTERS = COMPARISONS | MEMBERSHIPS | LOGICAL_EXPRESSIONS | MISSING_VALUES


@pytest.mark.parametrize(("expression", "runs"), FILTERS.items())
def test_filters_compare_columns(study: Path, expression: str, runs: str) -> None:
    table = gather(study)
    run = filter_rows(table, expression)["run"]
    text = "".join(run)
    assert text == runs


CALLS = [
    "__import__('os').system('touch pwned')",
    "order.__class__ == 1",
    "order == open('x')",
    "order.values == 1",
    "(lambda: 1)() == 1",
]
OTHER_PYTHON = [
    "[x for x in (1,)]",
    "@order",
    "order == 'a' or @order",
    "order = 8",
    "order == 8 if 1 else 2",
    "f'{order}' == '8'",
    "order[0] == 1",
]
NO_COMPARISON = ["nothing == 1", "order", "1 == 1", "", "order in order"]
WRONG_TYPES = ["order == 'eight'", "order < null"]
TOO_DEEP = "(" * 500


@pytest.mark.parametrize(
    "expression", [*CALLS, *OTHER_PYTHON, *NO_COMPARISON, *WRONG_TYPES, TOO_DEEP]
)
def test_filters_evaluate_nothing_else(
    study: Path, expression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(study)
    with pytest.raises(BadRequest, match="where"):
        filter_rows(gather(study), expression)
    assert not (study / "pwned").exists()


def test_best_comes_first(study: Path) -> None:
    table = gather(study)
    run = rank_runs(table)["run"]
    text = "".join(run)
    assert text == "baedc"
    run = rank_runs(table, "fit_test_percent")["run"]
    text = "".join(run)
    assert text == "eabcd"
    run = rank_runs(table, "settling_time_mean_s")["run"]
    text = "".join(run)
    assert text == "bacde"
    with pytest.raises(BadRequest, match="by = nothing"):
        rank_runs(table, "nothing")


def test_what_is_shown_fits_and_explains(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show_table(study, where="order > 4")
    output = capsys.readouterr().out
    lines = output.splitlines()
    without_reason = [line for line in lines if "failed c:" not in line]
    largest = max(map(len, without_reason))
    assert largest <= 80
    assert "5 runs (4 shown): 3 ok, 1 infeasible, 1 failed" in output
    assert "failed c: the solver gave up" in output
    assert "infeasible d: rate 0.8 is too much" in output
    assert "\x1b" not in output


def test_a_run_without_certificate_is_listed_with_its_reason(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = {"status": "ok", "run": "b", "uncertified_reason": "observer: too few digits"}
    write_record(study / "b", record)
    show_table(study)
    output = capsys.readouterr().out
    assert "not certified b: observer: too few digits" in output
    assert output.count("not certified ") == 1


def test_the_column_sorted_by_is_shown_and_a_misspelt_one_is_answered_with_the_nearest(
    study: Path,
) -> None:
    table = gather(study)
    by_error = rank_runs(table, "rmse_test")
    lines = render_table(by_error, "rmse_test").splitlines()
    heads = lines[0].split()
    assert heads[:3] == ["run", "rmse", "status"]
    by_fit = rank_runs(table, "fit_test_percent")
    lines = render_table(by_fit, "fit_test_percent").splitlines()
    heads = lines[0].split()
    assert heads[1:3] == ["fit", "%"]
    nearest = "did you mean fit_test_percent"
    with pytest.raises(BadRequest, match=nearest):
        rank_runs(table, "fit_tets_percent")
    with pytest.raises(BadRequest, match=nearest):
        filter_rows(table, "fit_tets_percent > 1")


def test_a_path_in_a_reason_stays_in_one_piece(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It can be copied out of the terminal, however long."""
    path = "/home/somebody/" + "-a-long-name" * 15
    record = {"status": "failed", "error_message": f"cannot read {path}", "run": "c"}
    write_record(study / "c", record)
    show_table(study)
    assert path in capsys.readouterr().out


def test_no_cell_is_a_formula_and_no_name_commands_the_terminal(study: Path) -> None:
    formula = "=HYPERLINK(1)"
    record = {"status": "failed", "error_message": formula}
    record |= {"plant": "\x1b[2J", "run": "c"}
    write_record(study / "c", record)
    table = gather(study)
    text = (study / "runs.csv").read_text()
    assert "'=HYPERLINK(1)" in text
    # The table itself says what it was.
    message = table.set_index("run").loc["c", "error_message"]
    assert message == formula
    summary = "\n".join(status_summary_lines(table, 5))
    printed = render_table(table) + summary
    assert "\x1b" not in printed
    assert "\\x1b[2J" in printed


FINITE = st.floats(allow_nan=False, allow_infinity=False)
TEXT = st.text()
VALUES = st.none() | st.booleans() | st.integers() | FINITE | TEXT
FLAT = st.dictionaries(TEXT, VALUES)


@given(FLAT)
def test_a_record_is_written_as_json_with_an_indent_is(record: dict[str, object]) -> None:
    text = json.dumps(record, indent=1, ensure_ascii=False)
    expected = f"{text}\n".encode("utf-8", "surrogatepass")
    assert json_bytes(record) == expected


def test_a_missing_study_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadRequest, match="no such study folder"):
        gather(tmp_path / "nothing")
    with pytest.raises(BadRequest, match="there is no run in it"):
        gather(tmp_path)
    paths = list(tmp_path.iterdir())
    assert paths == []


def change_something(study: Path, what: str) -> None:
    """Make one of the changes that may happen between two gatherings."""
    if what == "new run":
        (study / "f").mkdir()
        record = {"status": "ok", "run": "f"}
        record |= {"seed": 7, "extra": 2.5, "newly": True}
        write_record(study / "f", record)
    if what == "changed run":
        record = {"status": "ok", "fit_test_percent": 1.0}
        write_record(study / "c", record)
    if what == "removed run":
        record_path = study / "b" / "record.json"
        record_path.unlink()
    if what == "started run":
        record = {"status": "running"}
        write_record(study / "d", record)
    if what == "damaged table":
        content = bytearray((study / "runs.parquet").read_bytes())
        content[len(content) // 3] ^= 4
        (study / "runs.parquet").write_bytes(content)
    if what == "damaged index":
        text = (study / ".gathered.json").read_text()
        damaged = text.replace("0", "1", 1)
        (study / ".gathered.json").write_text(damaged)
    if what == "table by hand":
        (study / "runs.csv").write_text("run\nx\n")


NEW_RUNS = ["new run", "started run"]
OTHER_RUNS = ["changed run", "removed run"]
DAMAGES = ["damaged table", "damaged index", "table by hand"]


@pytest.mark.parametrize("what", ["nothing", *NEW_RUNS, *OTHER_RUNS, *DAMAGES])
def test_gathering_step_by_step_equals_gathering_afresh(study: Path, what: str) -> None:
    gather(study)
    change_something(study, what)
    step_by_step = gather(study)
    names = ("runs.parquet", "runs.csv")
    files = {name: (study / name).read_bytes() for name in names}
    for name in (*files, ".gathered.json"):
        (study / name).unlink()
    afresh = gather(study)
    pd.testing.assert_frame_equal(step_by_step, afresh, check_dtype=False)
    bytes_by_name = {name: (study / name).read_bytes() for name in files}
    assert bytes_by_name == files


def test_only_what_has_changed_is_read_again(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ssm_study.table import gather as module

    read: list[str] = []
    original = module.read_record

    def read_and_note(folder: Path) -> object:
        read.append(folder.name)
        return original(folder)

    monkeypatch.setattr(module, "read_record", read_and_note)
    gather(study)
    gather(study)
    change_something(study, "changed run")
    change_something(study, "new run")
    gather(study)
    expected = ["a", "b", "c", "d", "e", "c", "f"]
    assert read == expected
