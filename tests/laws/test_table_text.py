"""Tables as text: what was swept comes first, reasons are counted, everything fits the width."""

import pandas as pd

from ssm_study.report.page.data import page_title
from ssm_study.table.columns import swept_settings
from ssm_study.table.filters import filter_rows
from ssm_study.table.gather import table_from_records
from ssm_study.table.show import cost_lines, render_table, stage_costs, summary_lines


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
    lines = render_table(table_from_records(wide)).splitlines()
    largest = max(map(len, lines))
    assert largest <= 80


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
    return table_from_records(rows)


def test_what_was_swept_stands_before_what_came_of_it() -> None:
    lines = render_table(sweep(6)).splitlines()
    heads, first = lines[:2]
    expected = ["run", "status", "order", "r", "ctl", "settled"]
    assert heads.split()[:6] == expected
    expected = ["0000000000", "ok", "0", "0", "9/10"]
    assert first.split() == expected


def test_settings_of_the_command_tell_runs_apart() -> None:
    """Settings that no column of their own repeats tell runs apart: in `show`, in filters and on
    the page."""
    sampling_times_s = (0.005, 0.02)
    settings = [(step_s, undone) for step_s in sampling_times_s for undone in (False, True)]
    table = table_from_records(
        {
            "run": f"r-{i}",
            "status": "ok",
            "plant__step_s": step_s,
            "synthesis__invert_input": undone,
            "loop__peer": "pi",
        }
        for i, (step_s, undone) in enumerate(settings)
    )
    expected = ["plant__step_s", "synthesis__invert_input"]
    assert swept_settings(table) == expected
    assert page_title(table) == "What changes with plant.step_s and synthesis.invert_input?"
    run = filter_rows(table, "plant__step_s > 0.01 and synthesis__invert_input")["run"]
    assert run.tolist() == ["r-3"]
    heads, *_, last = render_table(table).splitlines()
    expected = ["run", "status", "step_s", "invert_input"]
    assert heads.split() == expected
    expected = ["3", "ok", "0.02", "yes"]
    assert last.split() == expected


def test_a_side_that_nobody_certified_is_not_said_to_be() -> None:
    verdicts = [(True, True), (True, None), (None, True), (None, None)]
    rows = [
        {
            "run": f"r-{i}",
            "status": "ok",
            "controller_certified": controller,
            "observer_certified": observer,
        }
        for i, (controller, observer) in enumerate(verdicts)
    ]
    lines = render_table(table_from_records(rows)).splitlines()[1:]
    expected = ["both", "ctl", "obs", "-"]
    assert [line.split()[2] for line in lines] == expected


def test_a_setting_that_follows_from_another_gives_way_to_the_outcomes() -> None:
    """Two model classes differ in five settings: one says which is which, and the reader wants the
    fit."""
    rows = [
        {"run": "r-1", "status": "ok", "model": "ssm", "order": 4, "hidden_width": 32,
         "slope_lower": 0.01,
         "scaffold_in": "monotone", "scaffold_out": "linear", "fit_test_percent": 96.3,
         "stable_count": 10,
         "initial_conditions": 10, "resolved_margin": 2.156, "predicted_stable": True},
        {"run": "r-2", "status": "ok", "model": "structured", "order": 5, "slope_lower": 0.1,
         "fit_test_percent": 97.2,
         "stable_count": 10, "initial_conditions": 10, "resolved_margin": 1.697,
         "predicted_stable": True},
    ]  # fmt: skip
    lines = render_table(table_from_records(rows)).splitlines()
    heads = lines[0].split()
    assert heads[2] == "model"
    expected = ["settled", "fit", "%", "margin", "predicted"]
    assert heads[-5:] == expected
    assert "scaffold_out" not in heads
    # Where there is room.
    lines = render_table(table_from_records(rows), width=160).splitlines()
    assert "scaffold_out" in lines[0]


def test_one_reason_is_told_once() -> None:
    lines = summary_lines(sweep(20), printed_count=20)
    assert lines[1] == "20 runs: 10 ok, 10 infeasible"
    told = [f"{i:010d}" for i in range(10, 15)]
    assert lines[2:] == [f"  infeasible {', '.join(told)} and 5 more: too fast"]
    assert summary_lines(sweep(1), printed_count=1)[1] == "1 run: 1 ok"


def test_folds_are_told_with_their_mean_and_deviation() -> None:
    """Other rates and methods of a fold are the same model: they weigh no more than one."""
    scores = [(2, 0, 80.0), (2, 0, 80.0), (2, 1, 90.0), (4, 0, 85.0), (4, 1, None)]
    rows = [
        {
            "run": f"r-{k}",
            "status": "ok",
            "order": order,
            "fold": fold,
            "fit_test_percent": fit,
            "rate_controller": k,
        }
        for k, (order, fold, fit) in enumerate(scores)
    ]
    told = summary_lines(table_from_records(rows), 5)[2:]
    assert told[0] == "  2 folds: mean test fit 85 %, deviation 7.071 %, order 2"
    assert told[1] == "  1 folds: mean test fit 85 %, deviation - %, order 4"
    records = rows[:2]
    assert len(summary_lines(table_from_records(records), 2)) == 2  # one fold is no spread


def test_reasons_that_differ_in_a_number_are_one_line_with_its_range() -> None:
    rows = [
        {
            "run": f"r-{k}",
            "status": "infeasible",
            "infeasible_reason": f"rate {k / 10} of S_u2 is above 0.25; ask 3e-1",
        }
        for k in (9, 4, 7)
    ]
    assert summary_lines(table_from_records(rows), 3)[2:] == [
        "  infeasible 9, 4, 7: rate 0.4 to 0.9 of S_u2 is above 0.25; ask 3e-1"
    ]


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
    costs = stage_costs(table_from_records(runs))
    expected = [1, 10.0, 190.0]
    assert costs.loc["model", ["distinct", "spent_s", "saved_s"]].tolist() == expected
    expected = [20, 20.0, 0.0]
    assert costs.loc["loop", ["distinct", "spent_s", "saved_s"]].tolist() == expected
    assert costs.index[0] == "loop"
    expected = ["together", "30", "s", "3", "min"]
    assert cost_lines(table_from_records(runs))[-1].split() == expected
    assert cost_lines(table_from_records([]))
