"""Ranking of a study's runs, the best first, for the printed table, report page and figures.

It asks for a certificate first, then for the plant (did every start settle, and was that predicted
without the plant?), then for time, and among equals for the fit.
"""

import numpy as np
import pandas as pd

from ssm_study.refusal import BadRequest
from ssm_study.table.columns import (
    BY_NAME,
    boolean_column,
    numeric_column,
    suggest_column,
    text_column,
)

NO_FASTER = 0.995  # settling time over the uncontrolled one, from where it prints as 1.00


def outcome_class(table: pd.DataFrame) -> pd.Series:
    """Class of each run's outcome as a number, from 0 (certified and settles) to 6 (failed).

    0 certified and settles, 1 the same but no faster than without control, 2 certified only, 3 not
    certified, 4 a baseline, which has no controller, 5 infeasible, 6 failed, which any other status
    than ok counts as.
    """
    controller_certified = boolean_column(table, "controller_certified")
    observer_certified = boolean_column(table, "observer_certified")
    certified = controller_certified & observer_certified
    status = text_column(table, "status")
    no_verdict = numeric_column(table, "controller_certified").isna()
    feasible = numeric_column(table, "controller_feasible")
    no_controller = feasible.isna() & no_verdict
    stable_fraction = numeric_column(table, "stable_fraction")
    settles = certified & (stable_fraction >= 1)
    expected_ends = ["ok", "infeasible"]
    ratio = settling_ratio(table)
    cases = {
        6: ~status.isin(expected_ends),
        5: status == "infeasible",
        4: no_controller,
        1: settles & (ratio >= NO_FASTER),
        0: settles,
        2: certified,
    }  # the first that holds
    conditions = list(cases.values())
    classes = list(cases)
    best_class = np.select(conditions, classes, 3)
    return pd.Series(best_class, index=table.index)


def settling_ratio(table: pd.DataFrame) -> pd.Series:
    """Mean settling time of each run relative to that without control; NaN if either is unknown."""
    open_loop_s = numeric_column(table, "settling_time_open_loop_s")
    settling_time_s = numeric_column(table, "settling_time_mean_s")
    moving_open_loop_s = open_loop_s.where(open_loop_s > 0)
    return settling_time_s / moving_open_loop_s


def predicted_stable(table: pd.DataFrame) -> pd.Series:
    """For each run, whether the plant was predicted to be stable in closed loop.

    False where nothing is said.
    """
    return boolean_column(table, "predicted_stable")


def sort_best_first(table: pd.DataFrame) -> pd.DataFrame:
    """Results table sorted by outcome class, then prediction of stability, then settling time, then
    fit.

    The first row is the best run: of the certified ones that settle, the fastest of those that one
    would have chosen without the plant. Settling times are relative to the plant left alone where
    that is known, so plants compare.
    """
    time = numeric_column(table, "settling_time_mean_s")
    open_loop = numeric_column(table, "settling_time_open_loop_s")
    is_timed = time.notna()
    if open_loop[is_timed].notna().all():
        time = time / open_loop
    fit_percent_of_test = numeric_column(table, "fit_test_percent")
    fit = fit_percent_of_test.fillna(-np.inf)
    outcome = outcome_class(table)
    is_foreseen = predicted_stable(table)
    time_or_last = time.fillna(np.inf)
    keys = {"class": outcome, "unforeseen": ~is_foreseen, "time": time_or_last, "fit": -fit}
    key_table = pd.DataFrame(keys)
    key_names = list(keys)
    order = key_table.sort_values(key_names, kind="stable")
    return table.loc[order.index]


def rank_runs(table: pd.DataFrame, by: str | None = None) -> pd.DataFrame:
    """Results table sorted from best to worst run, or by one column, best value first.

    Raises `BadRequest` if the column is unknown.
    """
    if by is None:
        return sort_best_first(table).reset_index(drop=True)
    if by not in table:
        names = map(str, table)
        remedy = suggest_column(by, names)
        raise BadRequest("by", by, "no such column", remedy)
    high_is_better = by in BY_NAME and BY_NAME[by].better == "high"
    return table.sort_values(
        by, ascending=not high_is_better, na_position="last", kind="stable", ignore_index=True
    )
