"""Gathering and showing: typed columns in the agreed order, missing is null, filters compute nothing."""

import re
from pathlib import Path

import pandas as pd
import pytest

from ssm_study.refusal import BadRequest
from ssm_study.results.columns import COLUMNS
from ssm_study.results.cost import cost_lines, stage_costs
from ssm_study.results.filters import where
from ssm_study.results.gather import gather, table_of
from ssm_study.results.records import write_record
from ssm_study.results.show import plain_table, ranked, show, summary

RECORDS = [
    {
        "run": "a",
        "status": "ok",
        "order": 8,
        "fit_test_percent": 91.5,
        "stable_fraction": 1.0,
        "settling_time_mean_s": 2.0,
        "controller_certified": True,
        "extra": 1,
    },
    {
        "run": "b",
        "status": "ok",
        "order": 4,
        "fit_test_percent": 80.0,
        "stable_fraction": 1.0,
        "settling_time_mean_s": 1.0,
        "controller_certified": False,
    },
    {"run": "c", "status": "failed", "order": 8, "error_message": "the solver gave up"},
    {
        "run": "d",
        "status": "infeasible",
        "order": 6,
        "rate_controller": 0.8,
        "controller_feasible": False,
        "controller_rate_limit": 0.91,
    },
    {
        "run": "e",
        "status": "ok",
        "order": 6,
        "fit_test_percent": 99.0,
        "stable_fraction": 0.4,
        "mismatch_gain": float("inf"),
        "zz": "text",
    },
]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for record in RECORDS:
        folder = tmp_path / "study" / str(record["run"])
        folder.mkdir(parents=True)
        write_record(folder, {"study": "study", **record})
    (tmp_path / "study" / "no_run").mkdir()
    (tmp_path / "study" / ".hidden").mkdir()
    return tmp_path / "study"


def test_the_agreed_columns_come_first_with_their_types(study: Path) -> None:
    gather(study)
    table = pd.read_parquet(study / "runs.parquet", dtype_backend="numpy_nullable")
    agreed = [column.name for column in COLUMNS]
    assert list(table.columns[: len(agreed)]) == agreed
    assert list(table.columns[len(agreed) :]) == sorted(table.columns[len(agreed) :])
    assert {column.name: str(table[column.name].dtype) for column in COLUMNS} == {c.name: c.kind for c in COLUMNS}
    assert agreed[50] == "mismatch_margin"  # others rely on these; what follows is ours
    assert agreed[51:] == ["resolved_margin", "controller_radius", "predicted_stable"]


def test_the_agreed_columns_are_those_of_the_readers_page() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "engine.md").read_text()
    listed = re.search(r"```text columns\n(.*?)```", page, re.DOTALL)
    assert listed is not None
    assert re.findall(r"\w+", listed[1]) == [column.name for column in COLUMNS]


def test_missing_is_null_and_never_zero(study: Path) -> None:
    table = gather(study).set_index("run")
    assert table.loc["c", ["fit_test_percent", "seed", "controller_certified"]].isna().all()
    assert table.loc["e", "mismatch_gain"] == float("inf")
    assert table.loc["d", "controller_feasible"] == False  # noqa: E712
    lines = (study / "runs.csv").read_text().splitlines()
    assert lines[0].startswith("study,run,status,seed,order,hidden_width")
    assert lines[3].startswith("study,c,failed,,8,,")


def test_a_value_of_another_type_is_missing(study: Path) -> None:
    write_record(study / "c", {"status": "ok", "order": "eight", "fit_test_percent": True, "seed": 1.5, "study": "x"})
    row = gather(study).set_index("run").loc["c"]
    assert row[["order", "fit_test_percent", "seed"]].isna().all()
    assert row["study"] == "study"


def test_a_damaged_record_is_a_corrupt_row(study: Path) -> None:
    text = (study / "a" / "record.json").read_text()
    (study / "a" / "record.json").write_text(text.replace("91.5", "97.5"))
    row = gather(study).set_index("run").loc["a"]
    assert row["status"] == "corrupt"
    assert pd.isna(row["fit_test_percent"])


def test_gathering_twice_gives_the_same_bytes(study: Path) -> None:
    gather(study)
    first = (study / "runs.csv").read_bytes(), (study / "runs.parquet").read_bytes()
    gather(study)
    assert ((study / "runs.csv").read_bytes(), (study / "runs.parquet").read_bytes()) == first


@pytest.mark.parametrize(
    ("expression", "runs"),
    [
        ("order == 8", "ac"),
        ("order >= 6 and status == 'ok'", "ae"),
        ("80 < fit_test_percent <= 95", "a"),
        ("not (order == 8)", "bde"),
        ("order in [4, 6]", "bde"),
        ("order not in (4, 6)", "ac"),
        ("fit_test_percent == null", "cd"),
        ("fit_test_percent != None", "abe"),
        ("controller_certified", "a"),
        ("not controller_certified", "bcde"),
        ("mismatch_gain == inf or run == 'b'", "be"),
        ("controller_rate_limit > rate_controller", "d"),
        ("8 == order", "ac"),
        ("fit_test_percent > -1", "abe"),
    ],
)
def test_filters_compare_columns(study: Path, expression: str, runs: str) -> None:
    assert "".join(where(gather(study), expression)["run"]) == runs


@pytest.mark.parametrize(
    "expression",
    [
        "__import__('os').system('touch pwned')",
        "order.__class__ == 1",
        "order == open('x')",
        "[x for x in (1,)]",
        "@order",
        "order = 8",
        "nothing == 1",
        "order",
        "order == 'eight'",
        "order + 1 == 2",
        "(lambda: 1)() == 1",
        "order == 8 if 1 else 2",
        "f'{order}' == '8'",
        "order[0] == 1",
        "1 == 1",
        "",
        "order in order",
        "order < null",
        "(" * 500,
    ],
)
def test_filters_evaluate_nothing_else(study: Path, expression: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(study)
    with pytest.raises(BadRequest, match="where"):
        where(gather(study), expression)
    assert not (study / "pwned").exists()


def test_best_comes_first(study: Path) -> None:
    table = gather(study)
    assert "".join(ranked(table)["run"]) == "baecd"
    assert "".join(ranked(table, "fit_test_percent")["run"]) == "eabcd"
    assert "".join(ranked(table, "settling_time_mean_s")["run"]) == "bacde"
    with pytest.raises(BadRequest, match="by = nothing"):
        ranked(table, "nothing")


def test_what_is_shown_fits_and_explains(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show(study, where="order > 4")
    output = capsys.readouterr().out
    assert max(len(line) for line in output.splitlines() if "failed c:" not in line) <= 80
    assert "5 runs (4 shown): 3 ok, 1 infeasible, 1 failed" in output
    assert "failed c: the solver gave up" in output
    assert "infeasible d: controller at rate 0.8, limit 0.91" in output
    assert "\x1b" not in output


def test_a_run_without_certificate_is_listed_with_its_reason(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_record(study / "b", {"status": "ok", "run": "b", "uncertified_reason": "observer: too few digits"})
    show(study)
    output = capsys.readouterr().out
    assert "not certified b: observer: too few digits" in output
    assert output.count("not certified ") == 1


def test_a_wide_table_is_cut_to_eighty_columns() -> None:
    wide = [
        {
            "run": f"order{i}-width32-seed0-0123456789",
            "status": "infeasible",
            "seed": i,
            "order": i,
            "hidden_width": i,
            "slope_lower": i / 7,
            "slope_upper": i / 3,
            "rate_controller": i / 9,
        }
        for i in range(3)
    ]
    assert max(map(len, plain_table(table_of(wide)).splitlines())) <= 80


def sweep(count: int) -> pd.DataFrame:
    """`count` runs that differ in order and rate, the faster half infeasible for one reason."""
    rows = [
        {
            "run": f"order{i}-width32-seed0-{i:010d}",
            "order": i,
            "rate_controller": i / 100,
            "rate_observer": 0.1,
            "status": "ok" if i < count / 2 else "infeasible",
            "stable_count": 9 if i < count / 2 else None,
            "initial_conditions": 10,
            "infeasible_reason": None if i < count / 2 else "too fast",
        }
        for i in range(count)
    ]
    return table_of(rows)


def test_what_was_swept_stands_before_what_came_of_it() -> None:
    heads, first = plain_table(sweep(6)).splitlines()[:2]
    assert heads.split()[:6] == ["run", "status", "order", "r", "ctl", "settled"]
    assert first.split() == ["0000000000", "ok", "0", "0", "9/10"]


def test_one_reason_is_told_once() -> None:
    lines = summary(sweep(20), shown=20)
    assert lines[1] == "20 runs: 10 ok, 10 infeasible"
    told = [f"{i:010d}" for i in range(10, 15)]
    assert lines[2:] == [f"  infeasible {', '.join(told)} and 5 more: too fast"]
    assert summary(sweep(1), shown=1)[1] == "1 run: 1 ok"


def test_costs_count_each_stage_once() -> None:
    runs = [
        {
            "run": f"{i}",
            "stage_model_key": "m",
            "stage_model_seconds": 10.0,
            "stage_loop_key": f"l{i}",
            "stage_loop_seconds": 1.0,
        }
        for i in range(20)
    ]
    by_name = {cost.name: cost for cost in stage_costs(table_of(runs))}
    assert (by_name["model"].distinct, by_name["model"].spent_s, by_name["model"].saved_s) == (1, 10.0, 190.0)
    assert (by_name["loop"].distinct, by_name["loop"].spent_s, by_name["loop"].saved_s) == (20, 20.0, 0.0)
    assert cost_lines(table_of(runs))[-1].split() == ["together", "30", "s", "3", "min"]
    assert cost_lines(table_of([]))


def test_a_missing_study_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadRequest, match="no such study folder"):
        gather(tmp_path / "nothing")
    with pytest.raises(BadRequest, match="there is no run in it"):
        gather(tmp_path)
    assert list(tmp_path.iterdir()) == []


def change_something(study: Path, what: str) -> None:
    """What may happen between two gatherings."""
    if what == "new run":
        (study / "f").mkdir()
        write_record(study / "f", {"status": "ok", "run": "f", "seed": 7, "extra": 2.5, "newly": True})
    if what == "changed run":
        write_record(study / "c", {"status": "ok", "fit_test_percent": 1.0})
    if what == "removed run":
        (study / "b" / "record.json").unlink()
    if what == "started run":
        write_record(study / "d", {"status": "running"})
    if what == "damaged table":
        content = bytearray((study / "runs.parquet").read_bytes())
        content[len(content) // 3] ^= 4
        (study / "runs.parquet").write_bytes(content)
    if what == "damaged index":
        (study / ".gathered.json").write_text((study / ".gathered.json").read_text().replace("0", "1", 1))
    if what == "table by hand":
        (study / "runs.csv").write_text("run\nx\n")


@pytest.mark.parametrize(
    "what",
    [
        "nothing",
        "new run",
        "changed run",
        "removed run",
        "started run",
        "damaged table",
        "damaged index",
        "table by hand",
    ],
)
def test_gathering_step_by_step_equals_gathering_afresh(study: Path, what: str) -> None:
    gather(study)
    change_something(study, what)
    step_by_step = gather(study)
    files = {name: (study / name).read_bytes() for name in ("runs.parquet", "runs.csv")}
    for name in (*files, ".gathered.json"):
        (study / name).unlink()
    pd.testing.assert_frame_equal(step_by_step, gather(study), check_dtype=False)
    assert {name: (study / name).read_bytes() for name in files} == files


def test_only_what_has_changed_is_read_again(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ssm_study.results import gather as module

    read: list[str] = []
    original = module.read_record
    monkeypatch.setattr(module, "read_record", lambda folder: read.append(folder.name) or original(folder))
    gather(study)
    gather(study)
    change_something(study, "changed run")
    change_something(study, "new run")
    gather(study)
    assert read == ["a", "b", "c", "d", "e", "c", "f"]
