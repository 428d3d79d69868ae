"""Tables as text: what was swept comes first, reasons are counted, everything fits the width."""

from itertools import product
from pathlib import Path

import pandas as pd

from ssm_study.engine.records import write_record
from ssm_study.report.page.data import page_title
from ssm_study.table.columns import swept_settings
from ssm_study.table.doubts import row_count_warnings
from ssm_study.table.filters import filter_rows
from ssm_study.table.gather import gather, rows_differ_from_records, table_from_records
from ssm_study.table.rank import outcome_class, rank_runs
from ssm_study.table.show import (
    computing_time_lines,
    render_table,
    stage_computing_times,
    status_summary_lines,
)


def render_records(rows: list[dict[str, object]], **layout: int) -> list[str]:
    """The lines of the table of these records."""
    table = table_from_records(rows)
    text = render_table(table, **layout)
    return text.splitlines()


def make_wide_row(i: int) -> dict[str, object]:
    """One run of many settings."""
    row: dict[str, object] = {"run": f"order{i}-width32-seed0-0123456789"}
    row |= {"status": "infeasible", "rate_controller": i / 9}
    row |= {"seed": i, "order": i, "hidden_width": i}
    row |= {"slope_lower": i / 7, "slope_upper": i / 3}
    return row


def test_a_wide_table_is_cut_to_eighty_columns() -> None:
    rows = [make_wide_row(i) for i in range(3)]
    lines = render_records(rows)
    largest = max(map(len, lines))
    assert largest <= 80


def make_sweep_row(i: int, is_infeasible: bool) -> dict[str, object]:
    """The i-th run of a sweep over order and rate."""
    row: dict[str, object] = {"run": f"order{i}-width32-seed0-{i:010d}"}
    row |= {"order": i, "rate_controller": i / 100}
    row |= {"rate_observer": 0.1, "status": "ok"}
    row |= {"stable_count": 9, "initial_conditions": 10}
    row["infeasible_reason"] = None
    if is_infeasible:
        row["status"] = "infeasible"
        row["stable_count"] = None
        row["infeasible_reason"] = "too fast"
    return row


def sweep(count: int) -> pd.DataFrame:
    """`count` runs that differ in order and rate, the faster half infeasible for one reason."""
    rows = [make_sweep_row(i, i >= count / 2) for i in range(count)]
    return table_from_records(rows)


def test_what_was_swept_stands_before_what_came_of_it() -> None:
    table = sweep(6)
    lines = render_table(table).splitlines()
    heads = lines[0].split()
    first_row = lines[1].split()
    swept = ["run", "status", "order", "r", "ctl"]
    assert heads[:5] == swept
    assert heads[5] == "settled"
    expected = ["0000000000", "ok", "0", "0", "9/10"]
    assert first_row == expected


def test_settings_of_the_command_tell_runs_apart() -> None:
    """Settings that no column of their own repeats tell runs apart: in `show`, in filters and on
    the page."""
    settings = [(0.005, False), (0.005, True), (0.02, False), (0.02, True)]
    rows = []
    for i, (step_s, full) in enumerate(settings):
        row: dict[str, object] = {"run": f"r-{i}", "status": "ok"}
        row["plant__step_s"] = step_s
        row["synthesis__full"] = full
        row["loop__peer"] = "pi"
        rows.append(row)
    table = table_from_records(rows)
    expected = ["plant__step_s", "synthesis__full"]
    assert swept_settings(table) == expected
    assert page_title(table) == "What changes with plant.step_s and synthesis.full?"
    fine = "plant__step_s > 0.01 and synthesis__full"
    filtered = filter_rows(table, fine)
    assert filtered["run"].tolist() == ["r-3"]
    lines = render_table(table).splitlines()
    heads = lines[0]
    last = lines[-1]
    expected = ["run", "status", "step_s", "full"]
    assert heads.split() == expected
    expected = ["3", "ok", "0.02", "yes"]
    assert last.split() == expected


def test_a_side_that_nobody_certified_is_not_said_to_be() -> None:
    verdicts = [(True, True), (True, None), (None, True), (None, None)]
    rows = []
    for i, (controller, observer) in enumerate(verdicts):
        row: dict[str, object] = {"run": f"r-{i}", "status": "ok"}
        row["controller_certified"] = controller
        row["observer_certified"] = observer
        rows.append(row)
    _, *lines = render_records(rows)
    certified_sides = [line.split()[2] for line in lines]
    assert certified_sides == ["both", "ctl", "obs", "-"]


NONLINEAR_SETTINGS = {"hidden_width": 32, "scaffold_in": "monotone", "scaffold_out": "linear"}
NONLINEAR_RUN = {
    "run": "r-1",
    "status": "ok",
    "model": "ssm",
    "order": 4,
    "slope_lower": 0.01,
    "fit_test_percent": 96.3,
    "resolved_margin": 2.156,
}
STRUCTURED_RUN = {
    "run": "r-2",
    "status": "ok",
    "model": "structured",
    "order": 5,
    "slope_lower": 0.1,
    "fit_test_percent": 97.2,
    "resolved_margin": 1.697,
}
STABLE = {"stable_count": 10, "initial_conditions": 10, "predicted_stable": True}


def test_a_setting_that_follows_from_another_gives_way_to_the_outcomes() -> None:
    """Two model classes differ in five settings: one says which is which, and the reader wants the
    fit."""
    nonlinear_run = NONLINEAR_RUN | NONLINEAR_SETTINGS | STABLE
    structured_run = STRUCTURED_RUN | STABLE
    rows = [nonlinear_run, structured_run]
    lines = render_records(rows)
    heads = lines[0].split()
    assert heads[2] == "model"
    expected = ["settled", "fit", "%", "margin", "predicted"]
    assert heads[-5:] == expected
    assert "scaffold_out" not in heads
    wide_lines = render_records(rows, width=160)  # where there is room
    assert "scaffold_out" in wide_lines[0]


def test_one_reason_is_told_once() -> None:
    table = sweep(20)
    lines = status_summary_lines(table, printed_count=20)
    assert lines[1] == "20 runs: 10 ok, 10 infeasible"
    keys = [f"{i:010d}" for i in range(10, 15)]
    listed = ", ".join(keys)
    assert lines[2:] == [f"  infeasible {listed} and 5 more: too fast"]
    single = sweep(1)
    summary = status_summary_lines(single, printed_count=1)
    assert summary[1] == "1 run: 1 ok"


def make_fold_row(k: int, order: int, fold: int, fit: float | None) -> dict[str, object]:
    """One run of a fold, with its rate."""
    row: dict[str, object] = {"run": f"r-{k}", "status": "ok"}
    row |= {"order": order, "fold": fold}
    row |= {"fit_test_percent": fit, "rate_controller": k}
    return row


def test_folds_are_told_with_their_mean_and_deviation() -> None:
    """Other rates and methods of a fold are the same model: they weigh no more than one."""
    rows = [
        make_fold_row(0, 2, 0, 80.0),
        make_fold_row(1, 2, 0, 80.0),
        make_fold_row(2, 2, 1, 90.0),
    ]
    rows.append(make_fold_row(3, 4, 0, 85.0))
    rows.append(make_fold_row(4, 4, 1, None))
    table = table_from_records(rows)
    summary = status_summary_lines(table, 5)
    assert summary[2] == "  2 folds: mean test fit 85 %, deviation 7.071 %, order 2"
    assert summary[3] == "  1 folds: mean test fit 85 %, deviation - %, order 4"
    of_one_fold = table_from_records(rows[:2])
    summary = status_summary_lines(of_one_fold, 2)
    assert len(summary) == 2  # one fold is no spread


def test_reasons_that_differ_in_a_number_are_one_line_with_its_range() -> None:
    rows = []
    for k in (9, 4, 7):
        reason = f"rate {k / 10} of S_u2 is above 0.25; ask 3e-1"
        row = {"run": f"r-{k}", "status": "infeasible"}
        row["infeasible_reason"] = reason
        rows.append(row)
    table = table_from_records(rows)
    reasons = status_summary_lines(table, 3)[2:]
    expected = "  infeasible 9, 4, 7: rate 0.4 to 0.9 of S_u2 is above 0.25; ask 3e-1"
    assert reasons == [expected]


def test_a_failure_of_the_machine_is_run_again_by_the_same_command() -> None:
    """Which of two failures needs `--retry-failed` could not be read."""
    full_disk: dict[str, object] = {"run": "r-1", "status": "failed"}
    full_disk |= {"error_message": "No space left", "failure_transient": True}
    mistake: dict[str, object] = {"run": "r-2", "status": "failed"}
    mistake |= {"error_message": "singular", "failure_transient": False}
    table = table_from_records([full_disk, mistake])
    reasons = status_summary_lines(table, 2)[2:]
    again = "  failed 1: No space left; the same command runs it again"
    assert sorted(reasons) == [again, "  failed 2: singular"]


def test_costs_count_each_stage_once() -> None:
    rows = []
    for i in range(20):
        row: dict[str, object] = {"run": f"{i}"}
        row |= {"stage_model_key": "m", "stage_model_seconds": 10.0}
        row |= {"stage_loop_key": f"l{i}", "stage_loop_seconds": 1.0}
        rows.append(row)
    table = table_from_records(rows)
    costs = stage_computing_times(table)
    counted = costs[["distinct", "spent_s", "saved_s"]]
    of_the_model = counted.loc["model"].tolist()
    assert of_the_model == [1, 10.0, 190.0]
    of_the_loop = counted.loc["loop"].tolist()
    assert of_the_loop == [20, 20.0, 0.0]
    assert costs.index[0] == "loop"
    together = computing_time_lines(table)[-1]
    expected = ["together", "30", "s", "3", "min"]
    assert together.split() == expected
    of_no_run = table.assign(stage_bounds_key=None, stage_bounds_seconds=None)
    (line,) = [line for line in computing_time_lines(of_no_run) if line.startswith("bounds")]
    assert line.split() == ["bounds", "0", "0", "0", "0.00", "s", "0", "s", "0", "s"]
    empty = table_from_records([])
    assert computing_time_lines(empty)


SWEEP_TEXT = 'hydra:\n  overrides:\n    task: ["model.order=4,6", "seed=0,1"]\n'
GRID = list(product([4, 6], [0, 1]))
MISSING_RUNS = [
    (0, []),
    (1, ["1 of 4 runs of the sweep is missing"]),
    (2, ["2 of 4 runs of the sweep are missing"]),
]


def test_runs_of_the_sweep_that_have_no_row_are_counted(tmp_path: Path) -> None:
    (tmp_path / "multirun.yaml").write_text(SWEEP_TEXT)
    rows = [{"run": f"{order}{seed}", "order": order, "seed": seed} for order, seed in GRID]
    for missing, expected in MISSING_RUNS:
        table = table_from_records(rows[missing:])
        sentences = row_count_warnings(tmp_path, table)
        counts = [sentence.partition(" (")[0] for sentence in sentences]
        assert counts == expected


def test_outcomes_have_seven_classes_from_settled_to_failed() -> None:
    certified = {"status": "ok", "controller_certified": True, "observer_certified": True}
    settled = certified | {"stable_fraction": 1.0}
    faster = settled | {"settling_time_mean_s": 1.9, "settling_time_open_loop_s": 2.0}
    no_faster = faster | {"settling_time_mean_s": 2.0}
    unsettled = faster | {"stable_fraction": 0.9}
    uncertified = settled | {"observer_certified": False}
    baseline = {"status": "ok", "fit_test_percent": 99.0}
    infeasible = baseline | {"status": "infeasible"}
    lost = settled | {"status": "lost"}
    rows = [faster, no_faster, unsettled, uncertified, baseline, infeasible, lost, settled]
    named = [row | {"run": str(number)} for number, row in enumerate(rows)]
    table = table_from_records(named)
    classes = outcome_class(table)
    assert classes.tolist() == [0, 1, 2, 3, 4, 5, 6, 0]


def test_a_table_without_reasons_names_no_run_as_not_certified() -> None:
    table = sweep(4).drop(columns="uncertified_reason")
    text = " ".join(status_summary_lines(table, 4))
    assert "not certified" not in text


def test_a_row_that_contradicts_its_record_is_seen(tmp_path: Path) -> None:
    for run, order in (("a", 4), ("b", 8)):
        record = {"status": "ok", "run": run, "order": order}
        (tmp_path / run).mkdir()
        write_record(tmp_path / run, record)
    table = gather(tmp_path)
    assert not rows_differ_from_records(tmp_path, table)
    table.loc[1, "order"] = 6
    assert rows_differ_from_records(tmp_path, table)


def test_of_runs_that_are_alike_the_better_fit_comes_first() -> None:
    rows = [{"run": str(fit), "status": "ok", "fit_test_percent": float(fit)} for fit in (80, 90)]
    table = table_from_records(rows)
    ranked = rank_runs(table)
    assert ranked["run"].tolist() == ["90", "80"]


def test_beside_a_plant_that_never_moves_no_loop_is_slower() -> None:
    row: dict[str, object] = {"run": "a", "status": "ok", "stable_fraction": 1.0}
    row |= {"controller_certified": True, "observer_certified": True}
    row |= {"settling_time_mean_s": 1.0, "settling_time_open_loop_s": 0.0}
    table = table_from_records([row])
    assert outcome_class(table).tolist() == [0]
