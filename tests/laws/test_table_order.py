"""Order of the table: classes of outcomes, the best run first, means over seeds."""

from collections.abc import Mapping
from typing import Any

import pandas as pd
import pytest

from ssm_study.table.gather import _value_of_kind, table_from_records
from ssm_study.table.over_seeds import seed_statistics_lines
from ssm_study.table.rank import outcome_class, rank_runs, settling_ratio, sort_best_first

Row = dict[str, Any]
CERTIFIED: Row = {"status": "ok", "controller_certified": True, "observer_certified": True}
SETTLED = CERTIFIED | {"stable_fraction": 1.0, "predicted_stable": True}


def table_of(*rows: Mapping[str, Any]) -> pd.DataFrame:
    """Table of these runs, named by their number where they have no name."""
    named = [{"run": f"r-{number}", **row} for number, row in enumerate(rows)]
    return table_from_records(named)


def test_a_loop_that_prints_as_one_is_no_faster() -> None:
    times = [(0.99, 1.0), (0.995, 1.0), (0.9949, 1.0), (1.0, None), (None, 1.0), (1.0, -1.0)]
    rows = [
        SETTLED | {"settling_time_mean_s": seconds, "settling_time_open_loop_s": open_loop_s}
        for seconds, open_loop_s in times
    ]
    table = table_of(*rows)
    expected = [0, 1, 0, 0, 0, 0]
    classes = outcome_class(table)
    values = classes.tolist()
    assert values == expected
    ratio = settling_ratio(table)
    expected = [False] * 3 + [True] * 3
    values = ratio.isna().tolist()
    assert values == expected
    assert ratio[0] == 0.99


def test_a_controller_without_verdict_is_no_baseline() -> None:
    rows = [{"status": "ok", "controller_feasible": True}]
    rows.append({"status": "ok", "controller_certified": False})
    rows.append({"status": "ok", "controller_certified": True})
    rows.append({"status": "ok"})
    expected = [3, 3, 3, 4]
    table = table_of(*rows)
    classes = outcome_class(table)
    values = classes.tolist()
    assert values == expected


def test_of_one_class_a_prediction_then_the_ratio_of_times_decides() -> None:
    quick = SETTLED | {"settling_time_mean_s": 1.0, "settling_time_open_loop_s": 2.0}
    slow = SETTLED | {"settling_time_mean_s": 3.0, "settling_time_open_loop_s": 9.0}
    unpredicted = slow | {"settling_time_mean_s": 0.5, "predicted_stable": None}
    unsettled = SETTLED | {"settling_time_open_loop_s": None}
    table = table_of(unpredicted, quick, unsettled, slow)
    ranked = sort_best_first(table)
    expected = ["r-3", "r-1", "r-2", "r-0"]
    values = ranked["run"].tolist()
    assert values == expected
    # One time without control is unknown, so the times themselves are compared.
    unknown = slow | {"settling_time_open_loop_s": None}
    table = table_of(unknown, quick)
    ranked = sort_best_first(table)
    expected = ["r-1", "r-0"]
    values = ranked["run"].tolist()
    assert values == expected


def test_a_column_is_sorted_in_its_better_direction_and_missing_last() -> None:
    table = table_of({"resolved_margin": 1.0}, {}, {"resolved_margin": 2.0})
    expected = ["r-2", "r-0", "r-1"]
    ranked = rank_runs(table, "resolved_margin")
    values = ranked["run"].tolist()
    assert values == expected
    table = table_of({"seconds": 2.0}, {}, {"seconds": 1.0}, {"seconds": 1.0})
    ranked = rank_runs(table, "seconds")
    expected = ["r-2", "r-3", "r-0", "r-1"]
    values = ranked["run"].tolist()
    assert values == expected
    expected = [0, 1, 2, 3]
    values = ranked.index.tolist()
    assert values == expected
    further = table.assign(own=[3, 2, 1, 0])
    expected = [0, 1, 2, 3]
    ranked = rank_runs(further, "own")
    values = ranked["own"].tolist()
    assert values == expected


def test_means_over_seeds_need_two_seeds_of_one_setting() -> None:
    rows = [{"seed": seed, "fit_test_percent": 90.0} for seed in (0, 1)]
    table = table_of(*rows)
    lines = seed_statistics_lines(table)
    expected = ["setting", "seeds"]
    actual = lines[2].split()[:2]
    assert actual == expected
    expected = ["all", "2", "90", "±", "0"]
    actual = lines[3].split()[:5]
    assert actual == expected
    table = table_of(*rows)
    without_seeds = table.drop(columns="seed")
    lines = seed_statistics_lines(without_seeds)
    assert lines == []
    wide = [row | {"hidden_width": width} for row in rows for width in (8, None)]
    table = table_of(*wide)
    lines = seed_statistics_lines(table)
    actual = lines[2].split()[0]
    assert actual == "width"
    settings = [line.split()[0] for line in lines[3:]]
    assert settings == ["8", "-"]
    alone = [*wide[:3:2], {"seed": 0, "hidden_width": 16, "fit_test_percent": 1.0}]
    table = table_of(*alone)
    lines = seed_statistics_lines(table)
    assert len(lines) == 4
    table = table_of(*rows)
    without_fit = table.drop(columns="fit_test_percent")
    expected = ["all", "2", "-", "-", "-", "-"]
    lines = seed_statistics_lines(without_fit)
    words = lines[3].split()
    assert words == expected


KINDS: list[tuple[str, Any, Any]] = []
KINDS.append(("string", 3, "3"))
KINDS.append(("string", None, None))
KINDS.append(("boolean", True, True))
KINDS.append(("boolean", False, False))
KINDS.append(("boolean", 1, None))
KINDS.append(("boolean", "yes", None))
KINDS.append(("Int64", True, None))
KINDS.append(("Int64", 4, 4))
KINDS.append(("Int64", 4.0, 4))
KINDS.append(("Int64", 4.5, None))
KINDS.append(("Int64", "four", None))
KINDS.append(("Float64", True, None))
KINDS.append(("Float64", 4, 4.0))
KINDS.append(("Float64", "inf", float("inf")))
KINDS.append(("Float64", "-inf", float("-inf")))
KINDS.append(("Float64", "nan", None))
KINDS.append(("Float64", None, None))


@pytest.mark.parametrize(("kind", "stored", "expected"), KINDS)
def test_a_value_has_the_type_of_its_column_or_is_missing(
    kind: Any, stored: Any, expected: Any
) -> None:
    value = _value_of_kind(stored, kind)
    assert value == expected
    assert type(value) is type(expected)


FURTHER: list[tuple[list[Any], str]] = []
FURTHER.append(([True, None], "boolean"))
FURTHER.append(([1, 2], "Int64"))
FURTHER.append(([1, 2.5], "Float64"))
FURTHER.append(([1.5, "inf"], "Float64"))
FURTHER.append(([1, "word"], "string"))


@pytest.mark.parametrize(("values", "kind"), FURTHER)
def test_a_column_that_nobody_declares_is_of_the_kind_of_its_values(
    values: list[Any], kind: str
) -> None:
    rows = [{"run": str(number), "own": value} for number, value in enumerate(values)]
    table = table_of(*rows)
    assert str(table["own"].dtype) == kind
    missing = [value is None for value in values]
    assert table["own"].isna().tolist() == missing
